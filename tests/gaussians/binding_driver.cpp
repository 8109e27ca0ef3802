// Calls every function of binding.cpp with awkward sizes, for the sanitizers to watch.
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <random>
#include <vector>

struct Binding {
    const int64_t* face;
    const float *barycentric, *normal_offset, *offset, *log_scales, *quats, *corners, *rotations, *frame_quats, *lengths;
    int64_t N, F, B;
    float thickness;
};
struct Gradients {
    const float *means, *quats, *scales, *normals;
    float *barycentric, *normal_offset, *offset, *log_scales, *local_quats, *corners, *rotations, *frame_quats, *lengths;
};
extern "C" {
int32_t smplxpp_frames_forward(const float*, const int64_t*, int64_t, int64_t, int64_t, float*, float*, float*, float*, int64_t*,
                               int);
int32_t smplxpp_frames_backward(const float*, const int64_t*, const float*, const float*, const float*, const float*,
                             const float*, int64_t, int64_t, int64_t, float*, int);
int32_t smplxpp_world_forward(const Binding*, float*, float*, float*, float*, int);
int32_t smplxpp_world_backward(const Binding*, const Gradients*, int);
int32_t smplxpp_colors_forward(const int64_t*, const float*, const float*, const float*, const float*, const float*, int64_t,
                            int64_t, int, float*, int);
int32_t smplxpp_colors_backward(const int64_t*, const float*, const float*, const float*, const float*, const float*,
                             const float*, int64_t, int64_t, int64_t, int, float*, float*, float*, float*, float*, int);
}

static std::mt19937 generator(7);
static std::vector<float> numbers(int64_t count, float scale = 1) {
    std::normal_distribution<float> normal(0, scale);
    std::vector<float> out(count);
    for (float& x : out) x = normal(generator);
    return out;
}
static std::vector<int64_t> indices(int64_t count, int64_t bound) {
    std::vector<int64_t> out(count);
    for (int64_t& x : out) x = int64_t(generator() % bound);
    return out;
}

static void run(int64_t N, int64_t F, int64_t V, int64_t B, int64_t C, int K, int threads, bool degenerate, bool all) {
    auto vertices = numbers(3 * V * B, degenerate ? 0 : 1);
    const auto faces = indices(3 * F, V), face = indices(N, F);
    std::vector<float> corners(9 * B * F), rotations(9 * B * F), frame_quats(4 * B * F), lengths(B * F);
    int64_t flat = 0;
    smplxpp_frames_forward(vertices.data(), faces.data(), B, V, F, corners.data(), rotations.data(), frame_quats.data(),
                           lengths.data(), &flat, threads);
    if (degenerate && flat != B * F) std::puts("triangles without area were missed");
    for (float x : rotations)
        if (!std::isfinite(x)) std::puts("a rotation is not finite");
    const auto u = numbers(2 * N), gamma = numbers(N), offset = numbers(3 * N), logs = numbers(2 * N), quats = numbers(4 * N);
    const Binding in{face.data(), u.data(), gamma.data(), offset.data(), logs.data(), quats.data(), corners.data(),
                     rotations.data(), frame_quats.data(), lengths.data(), N, F, B, 0.01f};
    std::vector<float> means(3 * B * N), q(4 * B * N), scales(3 * B * N), normals(3 * B * N);
    smplxpp_world_forward(&in, means.data(), q.data(), scales.data(), normals.data(), threads);
    std::vector<float> gu(2 * N), gg(N), go(3 * N), gl(2 * N), gq(4 * N), gc(9 * B * F), gr(9 * B * F), gf(4 * B * F), ge(B * F);
    const Gradients full{means.data(), q.data(), scales.data(), normals.data(), gu.data(), gg.data(), go.data(), gl.data(),
                         gq.data(), gc.data(), gr.data(), gf.data(), ge.data()};
    const Gradients few{means.data(), nullptr, nullptr, nullptr, nullptr, gg.data(), nullptr, nullptr,
                        nullptr, nullptr, nullptr, nullptr, nullptr};
    smplxpp_world_backward(&in, all ? &full : &few, threads);
    std::vector<float> gv(3 * B * V);
    smplxpp_frames_backward(vertices.data(), faces.data(), rotations.data(), all ? gc.data() : nullptr,
                            all ? gr.data() : nullptr, gf.data(), all ? ge.data() : nullptr, B, V, F, gv.data(), threads);
    const auto dc = numbers(3 * N), sh = numbers(3 * K * N), cameras = numbers(3 * C);
    std::vector<float> colors(3 * C * N), gd(3 * N), gs(3 * K * N), gm(3 * N), gcam(3 * C * threads);
    smplxpp_colors_forward(face.data(), rotations.data(), dc.data(), sh.data(), means.data(), cameras.data(), N, C, K,
                           colors.data(), threads);
    smplxpp_colors_backward(face.data(), rotations.data(), dc.data(), sh.data(), means.data(), cameras.data(), colors.data(),
                            N, F, C, K, all ? gd.data() : nullptr, gs.data(), gm.data(), all ? gr.data() : nullptr,
                            all ? gcam.data() : nullptr, threads);
}

int main() {
    for (int threads : {1, 2, 5})
        for (int K : {0, 3, 8, 15})
            for (bool all : {true, false}) {
                run(1000, 37, 20, 2, 3, K, threads, false, all);
                run(3, 1, 3, 1, 1, K, threads, true, all);
                run(0, 5, 9, 1, 2, K, threads, false, all);
                run(2, 50, 9, 1, 0, K, threads, true, all);
            }
    std::puts("done");
}
