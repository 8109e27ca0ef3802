// What the stages of the Gaussian rasteriser share: the inputs as they come through the C interface, the workspace of one
// camera, and the layout of its rows.
//
//   project   one Gaussian -> its ellipse on the image                        gaussian_project.cpp
//   bin       depth sort; the list of Gaussians of each tile, front to back   gaussian_sort.cpp, gaussian_bin.cpp
//   blend     front to back over the list, 16 pixels at once                  gaussian_blend.cpp
//   unblend   back to front: sums over pixels of the gradients                gaussian_unblend.cpp
//   background  its share of the picture's gradient                           gaussian_background.cpp
//   chain     from those sums to means, quaternions, scales, opacities, pose  gaussian_chain.cpp
//
// An ellipse is kept as the Cholesky factor of its inverse covariance, scaled so that the exponent is a power of two:
//   o exp(-1/2 d' S^-1 d) = 2^(log_opacity - p^2 - q^2),   p = a dx + b dy,  q = c dy,   d = pixel centre - mean.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "common/buffer.hpp"

namespace smplxpp::gaussian {

constexpr int TILE = 16;    // pixels a side
constexpr int BLOCK = 4;    // a block of 4x4 pixels is one vector of 16 lanes
constexpr int BLOCKS = 16;  // blocks of a tile, row by row
constexpr float LOG2_E = 1.44269504f;
constexpr float ALPHA_MIN = 1.0f / 255.0f;
constexpr float LOG2_ALPHA_MIN = -7.99435344f;
constexpr float ALPHA_MAX = 0.999f;
constexpr float TRANSMITTANCE_MIN = 1e-4f;

// Fields are mirrored by ctypes structures in avatar/rendering/cpu.py.
struct Scene {
    int64_t count;
    int32_t channels;
    int32_t reserved;
    const float *means, *quats, *scales, *opacities, *features;  // (N, 3) (N, 4) (N, 3) (N) (N, D)
};
struct Camera {
    int32_t width, height;
    float near_plane, far_plane, eps2d;
    int32_t reserved;
    const float *viewmat, *intrinsics;  // (4, 4) (3, 3)
    const float* background;            // (D) or null
};
struct Gradients {
    float *means, *quats, *scales, *opacities, *features;
    double* viewmat;           // (3, 4), added to; null where not asked for
    float* background;         // (D); null where not asked for
    int32_t accumulate;        // add to means .. opacities instead of writing them
    int32_t accumulate_features;
};

// The ellipse of one Gaussian; the mean is split into whole pixels and the rest, so that its distance to a pixel of any
// image is exact to about 1e-6 pixels in single precision.
struct Ellipse {
    float a, b, c, log_opacity;
    float pixel_x, pixel_y, rest_x, rest_y;
};
// One Gaussian in the list of a tile; bit 4 * row + column of `blocks` says which blocks its ellipse touches, `above` and
// `below` how many rows of tiles it reaches further (255: that or more).
struct Hit {
    uint32_t gaussian;
    uint16_t blocks;
    uint8_t above, below;
};

// Rows of gradients: 16 floats at a time, so that one transposition sums a row. The first 16 hold six moments and the first
// ten channels, the next ones 16 further channels each.
constexpr int LANES_OF_ROW = 16;
constexpr int MOMENTS = 6;
constexpr int ROW_CHANNELS = 10;
inline int row_groups(int channels) { return channels <= ROW_CHANNELS ? 1 : 1 + (channels - ROW_CHANNELS + 15) / 16; }

// Threads for a pass that takes nanoseconds an item: waking and awaiting more of them would cost more than it saves, and on a
// busy machine many times that.
inline int threads_for(int64_t items, int threads) {
    constexpr int64_t ENOUGH = 65536;
    return (int)(items / ENOUGH < threads ? items / ENOUGH + 1 : threads);
}

struct Workspace {
    int32_t width = 0, height = 0, tiles_x = 0, tiles_y = 0;
    int64_t tiles() const { return (int64_t)tiles_x * tiles_y; }
    Buffer<Ellipse> ellipses;        // (N)
    Buffer<uint64_t> keys, sorted;   // (visible) depth bits and index
    const uint64_t* order = nullptr; // either of them: front to back, the index in the low half
    int64_t visible = 0;
    Buffer<Hit> hits;                // by tile, front to back
    Buffer<int64_t> tile_start;      // (tiles + 1)
    Buffer<int32_t> tile_work;       // (tiles) visits of blocks that the forward pass made
    Buffer<float> transmittance;     // (tiles, 16, 16) final, by block and lane
    Buffer<int32_t> stop;            // (tiles, 16, 16) position in the list from which the pixel takes nothing
    // Backward only. Each thread owns a run of tiles; a Gaussian within one thread's tiles has its gradients summed in row
    // `gaussian`, one that reaches further has `last - first` rows more, from `extra` on, for the threads after the first.
    struct Owners {
        uint32_t extra;
        uint16_t first, last;
    };
    Buffer<Owners> owners;           // (N)
    Buffer<float> rows;              // (N + extra rows, row_groups, 16)
    int64_t row_of(int64_t gaussian, int thread) const {
        const Owners o = owners[gaussian];
        return thread == o.first ? gaussian : (int64_t)o.extra + thread - o.first - 1;
    }
    // Scratch of binning, by thread.
    struct Emission {
        uint32_t tile;
        Hit hit;
    };
    std::vector<Buffer<Emission>> emissions;
    Buffer<int32_t> counts;          // (threads, tiles)
    Buffer<int64_t> histogram;       // (threads, digits), then (threads, tiles)
    size_t bytes() const;
};

void project(const Scene&, const Camera&, Workspace&, float* means2d, float* radii, float* depths, int threads);
void sort_by_depth(int64_t count, const float* depths, const float* radii, Workspace&, int threads);
void bin(Workspace&, int64_t count, const float* radii, int64_t most_hits, int threads);
void blend(const Scene&, const Camera&, Workspace&, float* image, float* alpha, int threads);
void unblend(const Scene&, const Camera&, Workspace&, const float* radii, const float* grad_image, const float* grad_alpha, int threads);
void sum_background(const Scene&, const Workspace&, const float* grad_image, float* grad_background, int threads);
void chain(const Scene&, const Camera&, const Workspace&, const float* radii, const Gradients&, int threads);

}  // namespace smplxpp::gaussian
