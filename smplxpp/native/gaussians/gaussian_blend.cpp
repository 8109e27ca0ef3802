// The picture: front to back over each tile's list, a block of 4x4 pixels at a time,
//   image = sum_i T_i alpha_i f_i + T background,   T_{i+1} = T_i (1 - alpha_i),
// with alpha clamped to ALPHA_MAX, skipped below ALPHA_MIN, and a pixel that stops before T would fall to TRANSMITTANCE_MIN.
// Tiles are independent, so they are dealt to the threads as these come: the picture does not depend on it.
#include <atomic>
#include <memory>

#include "gaussians/gaussian_tile.hpp"
#include "common/parallel.hpp"

namespace smplxpp::gaussian {

namespace {

constexpr int32_t NEVER = INT32_MAX;

// What a block carries from one chunk of the list to the next.
struct TileState {
    alignas(64) float transmittance[BLOCKS][LANES];  // 0 where the pixel has stopped
    alignas(64) float final[BLOCKS][LANES];          // transmittance at which it stopped
    alignas(64) int32_t stop[BLOCKS][LANES];
    alignas(64) float color[BLOCKS][ROW_CHANNELS][LANES];
};

struct Thread {
    TileState state;
    Chunk chunk;
    uint16_t list[BLOCKS][CHUNK + 1];
    int length[BLOCKS];
    alignas(64) float weight[CHUNK][LANES];
    Buffer<float> more;  // (BLOCKS, channels beyond ROW_CHANNELS, LANES)
};

// Rows of the list into one list a block, for the blocks that still take something.
void split_by_block(const Hit* hits, int n, uint32_t live, Thread& t) {
    for (int& length : t.length) length = 0;
    for (int i = 0; i < n; ++i) {
        for (uint32_t m = hits[i].blocks & live; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            t.list[block][t.length[block]++] = (uint16_t)i;
        }
    }
}

// Blends a chunk into one block; false once all of its pixels have stopped. D channels are kept in registers, the weights
// of each visit noted for the further ones. `visits` counts rows looked at.
//
// The opacity of the next row is begun before the present one is blended: it is a long chain of dependent operations,
// and a processor that met it last would run out of room to look ahead for other work.
template <int D, bool NOTE_WEIGHTS>
bool blend_block(Thread& t, int block, int32_t base, int& visits) {
    TileState& s = t.state;
    const Floats x = load(TILE_PIXELS.x[block]), y = load(TILE_PIXELS.y[block]);
    const Floats stop_at = broadcast(TRANSMITTANCE_MIN), one = broadcast(1.0f);
    Floats T = load(s.transmittance[block]), color[D];
    for (int j = 0; j < D; ++j) color[j] = load(s.color[block][j]);
    Mask live = T > zeros();
    uint16_t* list = t.list[block];
    const int n = t.length[block];
    list[n] = list[n - 1];
    int k = 0;
    bool alive = true;
    Opacity next(t.chunk.rows[list[0]], x, y);
    while (k < n) {
        const int i = list[k];
        const Floats alpha = next.alpha;
        next = Opacity(t.chunk.rows[list[k + 1]], x, y);
        Floats w = alpha * T, after = T * (one - alpha);
        const Mask kill = without(live, after > stop_at);
        if (__builtin_expect(any(kill), 0)) {
            store(s.final[block], where(kill, T, load(s.final[block])));
            store(s.stop[block], where(kill, broadcast(base + i), load(s.stop[block])));
            live = without(live, kill);
            w = where(live, w);
            after = where(live, after);
            if (!any(live)) {
                t.length[block] = k;  // the further channels of those before
                ++k;
                alive = false;
                T = after;
                break;
            }
        }
        T = after;
        const TileRow& row = t.chunk.rows[i];
        for (int j = 0; j < D; ++j) color[j] = fma(w, broadcast(row.channels[j]), color[j]);
        if (NOTE_WEIGHTS) store(t.weight[k], w);
        ++k;
    }
    visits += k;
    store(s.transmittance[block], T);
    for (int j = 0; j < D; ++j) store(s.color[block][j], color[j]);
    return alive;
}

// The channels beyond ROW_CHANNELS, G at a time, from the noted weights.
template <int G>
void blend_more(const Scene& scene, const Hit* hits, Thread& t, int block, int first) {
    Floats color[G];
    float* more = t.more.data() + ((int64_t)block * (scene.channels - ROW_CHANNELS) + first) * LANES;
    for (int j = 0; j < G; ++j) color[j] = load(more + j * LANES);
    for (int k = 0; k < t.length[block]; ++k) {
        const float* f = scene.features + (int64_t)hits[t.list[block][k]].gaussian * scene.channels + ROW_CHANNELS + first;
        const Floats w = load(t.weight[k]);
        for (int j = 0; j < G; ++j) color[j] = fma(w, broadcast(f[j]), color[j]);
    }
    for (int j = 0; j < G; ++j) store(more + j * LANES, color[j]);
}

void write_empty_tile(const Scene& scene, const Camera& camera, const Workspace& w, int64_t tile, float* image, float* alpha) {
    const int x = (int)(tile % w.tiles_x) * TILE, y = (int)(tile / w.tiles_x) * TILE, D = scene.channels;
    const int columns = std::min(TILE, w.width - x), rows = std::min(TILE, w.height - y);
    for (int r = 0; r < rows; ++r) {
        const int64_t pixel = (int64_t)(y + r) * w.width + x;
        std::fill(alpha + pixel, alpha + pixel + columns, 0.0f);
        float* out = image + pixel * D;
        if (!camera.background) {
            std::fill(out, out + (int64_t)columns * D, 0.0f);
        } else {
            for (int i = 0; i < columns; ++i) std::copy(camera.background, camera.background + D, out + (int64_t)i * D);
        }
    }
}

// FIXED channels, or any number where that is 0.
template <int FIXED>
void write_tile(const Scene& scene, const Camera& camera, Workspace& w, Thread& t, int64_t tile, float* image, float* alpha) {
    TileState& s = t.state;
    const int D = FIXED ? FIXED : scene.channels, near = std::min(D, ROW_CHANNELS);
    for (int block = 0; block < BLOCKS; ++block) {
        const BlockPlace place(w, tile, block);
        const int64_t kept = (tile * BLOCKS + block) * LANES;
        const Floats T = load(s.transmittance[block]);
        store(s.final[block], where(T > zeros(), T, load(s.final[block])));
        store(&w.transmittance[kept], load(s.final[block]));
        store(&w.stop[kept], load(s.stop[block]));
        for (int r = 0; r < place.rows; ++r) {
            for (int c = 0; c < place.columns; ++c) {
                const int lane = 4 * r + c;
                const int64_t pixel = (int64_t)(place.y + r) * w.width + place.x + c;
                const float left = s.final[block][lane];
                float* out = image + pixel * D;
                alpha[pixel] = 1.0f - left;
                for (int j = 0; j < near; ++j) out[j] = s.color[block][j][lane];
                for (int j = near; j < D; ++j) out[j] = t.more[((int64_t)block * (D - near) + j - near) * LANES + lane];
                if (camera.background) {
                    for (int j = 0; j < D; ++j) out[j] += left * camera.background[j];
                }
            }
        }
    }
}

template <int D, bool MORE>
void blend_tile(const Scene& scene, const Camera& camera, Workspace& w, Thread& t, int64_t tile, float* image, float* alpha) {
    const int64_t begin = w.tile_start[tile], count = w.tile_start[tile + 1] - begin;
    w.tile_work[tile] = 0;
    if (count == 0) return write_empty_tile(scene, camera, w, tile, image, alpha);
    TileState& s = t.state;
    const int more = MORE ? scene.channels - ROW_CHANNELS : 0;
    uint32_t live = 0;
    for (int block = 0; block < BLOCKS; ++block) {
        const BlockPlace place(w, tile, block);
        if (!place.empty()) live |= 1u << block;
        for (int lane = 0; lane < LANES; ++lane) {
            const bool inside = place.inside(lane);
            s.transmittance[block][lane] = inside ? 1.0f : 0.0f;
            s.final[block][lane] = 1.0f;
            s.stop[block][lane] = inside ? NEVER : 0;
        }
    }
    std::memset(s.color, 0, sizeof s.color);
    if (MORE) std::memset(t.more.data(), 0, sizeof(float) * BLOCKS * LANES * more);
    const float x = (float)((tile % w.tiles_x) * TILE + TILE / 2), y = (float)((tile / w.tiles_x) * TILE + TILE / 2);
    int visits = 0;
    for (int64_t base = 0; base < count && live; base += CHUNK) {
        const Hit* hits = w.hits.data() + begin + base;
        const int n = (int)std::min<int64_t>(CHUNK, count - base);
        t.chunk.gather<D>(scene, w, hits, n, count - base, x, y);
        split_by_block(hits, n, live, t);
        for (uint32_t m = live; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            if (t.length[block] == 0) continue;
            if (!blend_block<D, MORE>(t, block, (int32_t)base, visits)) live &= ~(1u << block);
            if (MORE) {
                int j = 0;
                for (; more - j >= 16; j += 16) blend_more<16>(scene, hits, t, block, j);
                for (; more - j >= 4; j += 4) blend_more<4>(scene, hits, t, block, j);
                for (; j < more; ++j) blend_more<1>(scene, hits, t, block, j);
            }
        }
    }
    w.tile_work[tile] = visits;
    (scene.channels == D ? write_tile<D> : write_tile<0>)(scene, camera, w, t, tile, image, alpha);
}

template <int D, bool MORE>
void blend_tiles(const Scene& scene, const Camera& camera, Workspace& w, float* image, float* alpha, int threads) {
    constexpr int64_t DEALT = 4;  // neighbouring tiles share Gaussians
    std::atomic<int64_t> next{0};
    run_threads(threads, [&](int) {
        auto thread = std::make_unique<Thread>();
        if (MORE) thread->more.reserve((int64_t)BLOCKS * LANES * (scene.channels - ROW_CHANNELS));
        for (;;) {
            const int64_t begin = next.fetch_add(DEALT), end = std::min(begin + DEALT, w.tiles());
            if (begin >= end) break;
            for (int64_t tile = begin; tile < end; ++tile) blend_tile<D, MORE>(scene, camera, w, *thread, tile, image, alpha);
        }
    });
}

}  // namespace

void blend(const Scene& scene, const Camera& camera, Workspace& w, float* image, float* alpha, int threads) {
    w.tile_work.reserve(w.tiles());
    w.transmittance.reserve(w.tiles() * BLOCKS * LANES);
    w.stop.reserve(w.tiles() * BLOCKS * LANES);
    const int D = scene.channels;
    if (D <= 3) return blend_tiles<3, false>(scene, camera, w, image, alpha, threads);
    if (D <= 7) return blend_tiles<7, false>(scene, camera, w, image, alpha, threads);
    if (D <= ROW_CHANNELS) return blend_tiles<ROW_CHANNELS, false>(scene, camera, w, image, alpha, threads);
    return blend_tiles<ROW_CHANNELS, true>(scene, camera, w, image, alpha, threads);
}

}  // namespace smplxpp::gaussian
