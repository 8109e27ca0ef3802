// A stretch of a tile's list, gathered from all over memory into rows that lie in order in the first-level cache.
#pragma once
#include <algorithm>

#include "gaussian.hpp"
#include "simd.hpp"

namespace smplxpp::gaussian {

constexpr int CHUNK = 128;  // Gaussians gathered at once: 8 KiB of rows
constexpr int GATHER_AHEAD = 12;

// One Gaussian as a tile sees it: p = a x + b y + p0, q = c y + q0 at (x, y) from the tile's centre, and the first channels.
struct alignas(64) TileRow {
    float a, b, c, log_opacity, p0, q0;
    float channels[ROW_CHANNELS];
};
static_assert(sizeof(TileRow) == 64, "a row is a cache line");

struct Chunk {
    TileRow rows[CHUNK];

    // Hits [0, n) of the tile whose centre is (x, y); `limit` hits may be read ahead.
    SMPLXPP_INLINE void gather(const Scene& scene, const Workspace& w, const Hit* hits, int n, int64_t limit, float x, float y) {
        const int64_t channels = scene.channels;
        const int near = (int)std::min<int64_t>(channels, ROW_CHANNELS);
        for (int i = 0; i < n; ++i) {
            if (i + GATHER_AHEAD < limit) {
                const uint32_t next = hits[i + GATHER_AHEAD].gaussian;
                __builtin_prefetch(&w.ellipses[next]);
                __builtin_prefetch(scene.features + next * channels);
                __builtin_prefetch(scene.features + next * channels + near - 1);
            }
            const uint32_t g = hits[i].gaussian;
            const Ellipse& e = w.ellipses[g];
            TileRow& row = rows[i];
            const float dx = (e.pixel_x - x) + e.rest_x, dy = (e.pixel_y - y) + e.rest_y;
            row.a = e.a, row.b = e.b, row.c = e.c, row.log_opacity = e.log_opacity;
            row.p0 = -(e.a * dx + e.b * dy);
            row.q0 = -(e.c * dy);
            const float* f = scene.features + g * channels;
            for (int j = 0; j < near; ++j) row.channels[j] = f[j];
            for (int j = near; j < ROW_CHANNELS; ++j) row.channels[j] = 0.0f;
        }
    }
};

// Pixel centres of a tile's blocks from the tile's centre.
struct BlockPixels {
    Floats x, y;
    SMPLXPP_INLINE explicit BlockPixels(int block) {
        alignas(64) static const float column[LANES] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
        alignas(64) static const float row[LANES] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
        const float half = 0.5f * TILE - 0.5f;
        x = load(column) + broadcast((block & 3) * BLOCK - half);
        y = load(row) + broadcast((block >> 2) * BLOCK - half);
    }
};

// Where the 16 pixels of a block lie in the image; those outside are marked.
struct BlockPlace {
    int x, y, columns, rows;  // first pixel; how many columns and rows are inside, 0 .. 4
    BlockPlace(const Workspace& w, int64_t tile, int block)
        : x((int)(tile % w.tiles_x) * TILE + (block & 3) * BLOCK), y((int)(tile / w.tiles_x) * TILE + (block >> 2) * BLOCK),
          columns(std::clamp(w.width - x, 0, BLOCK)), rows(std::clamp(w.height - y, 0, BLOCK)) {}
    bool inside(int lane) const { return (lane & 3) < columns && (lane >> 2) < rows; }
    bool empty() const { return columns == 0 || rows == 0; }
};

// The exponent's parts at 16 pixels.
struct Exponent {
    Floats p, q, e;
    SMPLXPP_INLINE Exponent(const TileRow& row, const BlockPixels& at) {
        p = fma(broadcast(row.a), at.x, fma(broadcast(row.b), at.y, broadcast(row.p0)));
        q = fma(broadcast(row.c), at.y, broadcast(row.q0));
        e = fnma(p, p, fnma(q, q, broadcast(row.log_opacity)));
    }
};

}  // namespace smplxpp::gaussian
