// The C interface of the Gaussian rasteriser: one camera a call; see gaussian.hpp for the structures.
#include <chrono>

#include "gaussians/gaussian.hpp"
#include "common/parallel.hpp"

using namespace smplxpp::gaussian;
using smplxpp::guarded;

namespace {

// Seconds of each stage, added to `out` where it is given.
class StageClock {
public:
    explicit StageClock(double* out) : out_(out), last_(std::chrono::steady_clock::now()) {}
    void lap() {
        const auto now = std::chrono::steady_clock::now();
        if (out_) *out_++ += std::chrono::duration<double>(now - last_).count();
        last_ = now;
    }

private:
    double* out_;
    std::chrono::steady_clock::time_point last_;
};

}  // namespace

size_t Workspace::bytes() const {
    size_t sum = ellipses.bytes() + keys.bytes() + sorted.bytes() + hits.bytes() + tile_start.bytes() + tile_work.bytes() +
                 transmittance.bytes() + stop.bytes() + owners.bytes() + rows.bytes() + counts.bytes() + histogram.bytes();
    for (const Buffer<Emission>& notes : emissions) sum += notes.bytes();
    return sum;
}

SMPLXPP_EXPORT int32_t gaussian_workspace_new(void** workspace) {
    return guarded([&] { *workspace = new Workspace(); });
}
SMPLXPP_EXPORT int32_t gaussian_workspace_free(void* workspace) {
    return guarded([&] { delete (Workspace*)workspace; });
}
SMPLXPP_EXPORT int32_t gaussian_workspace_bytes(const void* workspace, int64_t* bytes) {
    return guarded([&] { *bytes = (int64_t)((const Workspace*)workspace)->bytes(); });
}

// Counts of the last forward pass: visible Gaussians, entries of all tile lists, visits of blocks.
SMPLXPP_EXPORT int32_t gaussian_counts(const void* workspace, int64_t counts[3]) {
    return guarded([&] {
        const Workspace& w = *(const Workspace*)workspace;
        counts[0] = w.visible;
        counts[1] = w.tiles() ? w.tile_start[w.tiles()] : 0;
        counts[2] = 0;
        for (int64_t t = 0; t < w.tiles(); ++t) counts[2] += w.tile_work[t];
    });
}

// image (H, W, D), alpha (H, W), means2d (N, 2), radii (N, 2), depths (N). The workspace then holds what
// gaussian_backward needs, until the next forward pass. most_hits: entries that the tile lists may have, else OVER_LIMIT,
// with means2d, radii and depths written. seconds: project, sort, bin, blend; may be null.
SMPLXPP_EXPORT int32_t gaussian_forward(void* workspace, const Scene* scene, const Camera* camera, float* image, float* alpha,
                                        float* means2d, float* radii, float* depths, int64_t most_hits, int32_t threads,
                                        double* seconds) {
    return guarded([&] {
        Workspace& w = *(Workspace*)workspace;
        StageClock clock(seconds);
        w.width = camera->width, w.height = camera->height;
        w.tiles_x = (w.width + TILE - 1) / TILE, w.tiles_y = (w.height + TILE - 1) / TILE;
        project(*scene, *camera, w, means2d, radii, depths, threads);
        clock.lap();
        sort_by_depth(scene->count, depths, radii, w, threads);
        clock.lap();
        bin(w, scene->count, radii, most_hits, threads);
        clock.lap();
        blend(*scene, *camera, w, image, alpha, threads);
        clock.lap();
    });
}

// Gradients of the last forward pass with this workspace. grad_image (H, W, D) and grad_alpha (H, W) may each be null for
// zero. seconds: unblend, chain; may be null.
SMPLXPP_EXPORT int32_t gaussian_backward(void* workspace, const Scene* scene, const Camera* camera, const float* radii,
                                         const float* grad_image, const float* grad_alpha, const Gradients* gradients,
                                         int32_t threads, double* seconds) {
    return guarded([&] {
        Workspace& w = *(Workspace*)workspace;
        StageClock clock(seconds);
        if (gradients->background) sum_background(*scene, w, grad_image, gradients->background, threads);
        unblend(*scene, *camera, w, radii, grad_image, grad_alpha, threads);
        clock.lap();
        chain(*scene, *camera, w, radii, *gradients, threads);
        clock.lap();
    });
}
