// Draws and differentiates nasty scenes through the C interface; built with sanitizers by test_sanitizers.py.
#include <cmath>
#include <cstdio>
#include <limits>
#include <random>
#include <vector>

#include "gaussians/gaussian.hpp"

using namespace smplxpp::gaussian;

extern "C" {
int32_t gaussian_workspace_new(void**);
int32_t gaussian_workspace_free(void*);
int32_t gaussian_workspace_bytes(const void*, int64_t*);
int32_t gaussian_forward(void*, const Scene*, const Camera*, float*, float*, float*, float*, float*, int64_t, int32_t,
                         double*);
int32_t gaussian_backward(void*, const Scene*, const Camera*, const float*, const float*, const float*, const Gradients*, int32_t, double*);
}

namespace {

struct Case {
    const char* name;
    int64_t count;
    int channels, width, height;
    float size, spread;
    int poisoned;  // numbers replaced by NaN, infinity and the like
    bool background, both_gradients;
};

const Case CASES[] = {
    {"plain", 500, 10, 67, 35, 0.05f, 0.5f, 0, true, true},
    {"no channel to spare", 300, 16, 40, 40, 0.1f, 0.5f, 0, false, true},
    {"many channels", 100, 43, 33, 17, 0.1f, 0.5f, 0, true, false},
    {"one pixel", 50, 1, 1, 1, 0.3f, 0.5f, 0, true, true},
    {"huge", 40, 3, 130, 50, 1e6f, 0.5f, 0, false, true},
    {"beyond any use", 40, 3, 50, 50, 1e30f, 1e20f, 0, true, true},
    {"of no size", 400, 4, 64, 64, 0.0f, 0.5f, 0, true, true},
    {"far outside", 400, 7, 64, 64, 0.05f, 1e4f, 0, true, true},
    {"nothing", 0, 3, 20, 20, 0.05f, 0.5f, 0, true, true},
    {"dense", 5000, 10, 17, 17, 0.05f, 0.1f, 0, true, true},
    {"poisoned", 200, 10, 48, 48, 0.05f, 0.5f, 40, true, true},
    {"poisoned and wide", 200, 12, 300, 20, 5.0f, 5.0f, 200, true, true},
};

void run(const Case& c, void* workspace, int threads, unsigned seed) {
    std::mt19937 rng(seed);
    std::normal_distribution<float> normal;
    const auto random = [&](int64_t n, float scale, float shift) {
        std::vector<float> v((size_t)n);
        for (float& x : v) x = shift + scale * normal(rng);
        return v;
    };
    const int64_t N = c.count, pixels = (int64_t)c.width * c.height;
    std::vector<float> means = random(3 * N, c.spread, 0), quats = random(4 * N, 1, 0), scales(3 * N), opacities(N),
                       features = random(N * c.channels, 1, 0), background = random(c.channels, 1, 0);
    for (float& s : scales) s = c.size * std::exp(0.5f * normal(rng));
    for (float& o : opacities) o = std::fmin(1.0f, std::fabs(normal(rng)));
    std::vector<float> view = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 2, 0, 0, 0, 1};
    std::vector<float> K = {(float)c.width, 0, c.width / 2.0f, 0, (float)c.width, c.height / 2.0f, 0, 0, 1};
    const float inf = std::numeric_limits<float>::infinity();
    const float poison[] = {NAN, inf, -inf, 3e38f, -3e38f, 1e-40f, 0.0f, -1.0f, 1e20f};
    std::vector<float>* targets[] = {&means, &quats, &scales, &opacities, &features, &means, &scales, &view, &K};
    for (int i = 0; i < c.poisoned; ++i) {
        std::vector<float>& target = *targets[rng() % (i < 4 ? 9 : 7)];
        target[rng() % target.size()] = poison[rng() % 9];
    }
    const Scene scene = {N, c.channels, 0, means.data(), quats.data(), scales.data(), opacities.data(), features.data()};
    const Camera camera = {c.width, c.height, 0.01f, 1e10f, 0.3f, 0, view.data(), K.data(), c.background ? background.data() : nullptr};
    std::vector<float> image(pixels * c.channels), alpha(pixels), means2d(2 * N), radii(2 * N), depths(N);
    if (gaussian_forward(workspace, &scene, &camera, image.data(), alpha.data(), means2d.data(), radii.data(), depths.data(), INT64_MAX, threads, nullptr)) {
        std::printf("%s: no memory\n", c.name);
        return;
    }
    const std::vector<float> grad_image = random(pixels * c.channels, 1, 0), grad_alpha = random(pixels, 1, 0);
    std::vector<float> to_means(3 * N), to_quats(4 * N), to_scales(3 * N), to_opacities(N), to_features(N * c.channels);
    std::vector<float> to_background(c.channels);
    std::vector<double> to_view(12);
    for (int accumulate = 0; accumulate < 2; ++accumulate) {
        const Gradients gradients = {to_means.data(), to_quats.data(), to_scales.data(), to_opacities.data(), to_features.data(),
                                     accumulate ? to_view.data() : nullptr, accumulate ? to_background.data() : nullptr, accumulate, accumulate};
        gaussian_backward(workspace, &scene, &camera, radii.data(), grad_image.data(), c.both_gradients ? grad_alpha.data() : nullptr,
                          &gradients, threads, nullptr);
    }
    double sum = 0;
    for (float x : image) sum += std::isfinite(x) ? x : 0;
    std::printf("%s: %g\n", c.name, sum);
}

}  // namespace

int main() {
    void* workspace = nullptr;
    gaussian_workspace_new(&workspace);
    for (int threads : {1, 3}) {
        for (const Case& c : CASES) run(c, workspace, threads, 7);
    }
    for (unsigned seed = 0; seed < 20; ++seed) run(CASES[11], workspace, 2, seed);
    int64_t bytes = 0;
    gaussian_workspace_bytes(workspace, &bytes);
    const bool sane = bytes > 0;
    gaussian_workspace_free(workspace);
    std::printf(sane ? "done\n" : "no workspace\n");
    return sane ? 0 : 1;
}
