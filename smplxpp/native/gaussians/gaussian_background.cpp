// Gradient of the background: sum over the pixels of T_end g, with the transmittance that the blend kept. 1 - alpha would
// have lost its digits where little light is left.
#include <algorithm>

#include "gaussians/gaussian.hpp"
#include "common/parallel.hpp"

namespace smplxpp::gaussian {

void sum_background(const Scene& scene, const Workspace& w, const float* grad_image, float* grad_background, int threads) {
    const int D = scene.channels;
    std::vector<double> sums((size_t)threads * D, 0.0);
    const auto sum_tile = [&](int64_t tile, double* sum) {
        const int left = (int)(tile % w.tiles_x) * TILE, top = (int)(tile / w.tiles_x) * TILE;
        const bool empty = w.tile_start[tile] == w.tile_start[tile + 1];
        for (int y = 0; y < std::min(TILE, w.height - top); ++y) {
            for (int x = 0; x < std::min(TILE, w.width - left); ++x) {
                const int block = y / BLOCK * (TILE / BLOCK) + x / BLOCK, lane = y % BLOCK * BLOCK + x % BLOCK;
                const float T = empty ? 1.0f : w.transmittance[(tile * BLOCKS + block) * LANES_OF_ROW + lane];
                const float* g = grad_image + ((int64_t)(top + y) * w.width + left + x) * D;
                for (int j = 0; j < D; ++j) sum[j] += (double)(T * g[j]);
            }
        }
    };
    if (grad_image) {
        run_threads(threads, [&](int t) {
            for (int64_t tile = w.tiles() * t / threads, end = w.tiles() * (t + 1) / threads; tile < end; ++tile) {
                sum_tile(tile, &sums[(size_t)t * D]);
            }
        });
    }
    for (int j = 0; j < D; ++j) {
        double sum = 0;
        for (int t = 0; t < threads; ++t) sum += sums[(size_t)t * D + j];
        grad_background[j] = (float)sum;
    }
}

}  // namespace smplxpp::gaussian
