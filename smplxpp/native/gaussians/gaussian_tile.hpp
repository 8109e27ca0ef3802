// A stretch of a tile's list, gathered from all over memory into rows that lie in order in the first-level cache.
#pragma once
#include <algorithm>

#include "gaussians/gaussian.hpp"
#include "common/simd.hpp"

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

    // Hits [0, n) of the tile whose centre is (x, y), with their first D channels; `limit` hits may be read ahead.
    template <int D>
    SMPLXPP_INLINE void gather(const Scene& scene, const Workspace& w, const Hit* hits, int n, int64_t limit, float x, float y) {
        const int64_t channels = scene.channels;
        for (int i = 0; i < n; ++i) {
            if (i + GATHER_AHEAD < limit) {
                const uint32_t next = hits[i + GATHER_AHEAD].gaussian;
                __builtin_prefetch(&w.ellipses[next]);
                __builtin_prefetch(scene.features + next * channels);
                __builtin_prefetch(scene.features + next * channels + std::min<int64_t>(channels, D) - 1);
            }
            const uint32_t g = hits[i].gaussian;
            const Ellipse e = w.ellipses[g];
            TileRow& row = rows[i];
            const float dx = (e.pixel_x - x) + e.rest_x, dy = (e.pixel_y - y) + e.rest_y;
            row.a = e.a, row.b = e.b, row.c = e.c, row.log_opacity = e.log_opacity;
            row.p0 = -(e.a * dx + e.b * dy);
            row.q0 = -(e.c * dy);
            const float* f = scene.features + g * channels;
            if (channels >= D) {
                std::memcpy(row.channels, f, sizeof(float) * D);
            } else {
                for (int j = 0; j < D; ++j) row.channels[j] = j < channels ? f[j] : 0.0f;
            }
        }
    }
};

// Pixel centres of a tile's blocks from the tile's centre.
struct TilePixels {
    alignas(64) float x[BLOCKS][LANES], y[BLOCKS][LANES];
    constexpr TilePixels() : x(), y() {
        for (int block = 0; block < BLOCKS; ++block) {
            for (int lane = 0; lane < LANES; ++lane) {
                x[block][lane] = (float)((block & 3) * BLOCK + (lane & 3)) + 0.5f - 0.5f * TILE;
                y[block][lane] = (float)((block >> 2) * BLOCK + (lane >> 2)) + 0.5f - 0.5f * TILE;
            }
        }
    }
};
inline constexpr TilePixels TILE_PIXELS;

// A Gaussian's opacity at the 16 pixels of a block, with what led to it.
struct Opacity {
    Floats p, q, alpha;
    SMPLXPP_INLINE Opacity(const TileRow& row, Floats x, Floats y, Mask allowed) {
        const Floats e = exponent(row, x, y);
        alpha = where((e >= broadcast(LOG2_ALPHA_MIN)) & allowed, min(exp2(e), broadcast(ALPHA_MAX)));
    }
    SMPLXPP_INLINE Opacity(const TileRow& row, Floats x, Floats y) {
        const Floats e = exponent(row, x, y);
        alpha = where(e >= broadcast(LOG2_ALPHA_MIN), min(exp2(e), broadcast(ALPHA_MAX)));
    }

private:
    SMPLXPP_INLINE Floats exponent(const TileRow& row, Floats x, Floats y) {
        p = fma(broadcast(row.a), x, fma(broadcast(row.b), y, broadcast(row.p0)));
        q = fma(broadcast(row.c), y, broadcast(row.q0));
        return fnma(p, p, fnma(q, q, broadcast(row.log_opacity)));
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

}  // namespace smplxpp::gaussian
