// Derivatives of the picture, back to front over each tile's list. With d_i = g . f_i at a pixel (g the gradient of the
// picture there) and S_i = sum_{k > i} T_k alpha_k d_k + T_end (g . background - g_alpha),
//   dL/df_i = T_i alpha_i g,    dL/dalpha_i = T_i d_i - S_i / (1 - alpha_i),
// and T_i = T_{i+1} / (1 - alpha_i) walks back from the final transmittance. With v = alpha dL/dalpha (0 where alpha is
// clamped) the sums over the pixels of v, v p, v q, v p^2, v p q, v q^2 hold all that the ellipse needs.
//
// Every thread owns a run of tiles, cut by the work that the forward pass measured, and adds into rows of its own: the
// sums are the same, bit for bit, whenever the number of threads is.
#include <cmath>
#include <memory>

#include "gaussians/gaussian_tile.hpp"
#include "common/parallel.hpp"

namespace smplxpp::gaussian {

namespace {

// What a block carries from one Gaussian to the one before it: T_{i+1}, S_i, and where its pixels stopped.
struct alignas(64) BlockState {
    float transmittance[LANES], rest[LANES];
    int32_t stop[LANES];
    float weight[LANES];
};

struct Thread {
    Chunk chunk;
    float* row[CHUNK];
    uint16_t visits[CHUNK * BLOCKS + 1];  // 16 * place in the chunk + block, back to front
    BlockState state[BLOCKS];
    int32_t last[BLOCKS];    // entries of the list that reach a block
    Buffer<float> gradient;  // (BLOCKS, D or more, LANES)
    int64_t plane;           // floats of `gradient` a block
};

// First tile of each thread, so that all have about the same work; the last entry is the number of tiles.
std::vector<int64_t> cut_tiles(const Workspace& w, int threads) {
    constexpr int64_t COST_OF_TILE = 4;  // in visits
    int64_t total = 0, sum = 0;
    for (int64_t t = 0; t < w.tiles(); ++t) total += w.tile_work[t] + COST_OF_TILE;
    std::vector<int64_t> cut(threads + 1, w.tiles());
    cut[0] = 0;
    int next = 1;
    for (int64_t t = 0; t < w.tiles() && next < threads; ++t) {
        sum += w.tile_work[t] + COST_OF_TILE;
        while (next < threads && sum >= total / threads * next) cut[next++] = t + 1;
    }
    return cut;
}

// The threads that own the tiles of each row of tiles.
struct RowOwners {
    std::vector<int> first, last;
    RowOwners(const Workspace& w, const std::vector<int64_t>& cut) : first(w.tiles_y), last(w.tiles_y) {
        const auto owner = [&](int64_t tile) { return (int)(std::upper_bound(cut.begin(), cut.end() - 1, tile) - cut.begin()) - 1; };
        for (int y = 0; y < w.tiles_y; ++y) {
            first[y] = owner((int64_t)y * w.tiles_x);
            last[y] = owner((int64_t)(y + 1) * w.tiles_x - 1);
        }
    }
};

// Which threads touch each visible Gaussian, from the tile rows of its box; returns the number of rows of gradients.
int64_t assign_rows(int64_t count, const float* radii, Workspace& w, const RowOwners& owners, int threads) {
    w.owners.reserve(count);
    threads = threads_for(count, threads);
    std::vector<int64_t> extra(threads + 1, 0);
    const auto each = [&](int t, auto&& work) {
        for (int64_t i = count * t / threads, end = count * (t + 1) / threads; i < end; ++i) {
            if (radii[2 * i] > 0) work(i);
        }
    };
    run_threads(threads, [&](int t) {
        int64_t sum = 0;
        each(t, [&](int64_t i) {
            // A little more than the box that binning took.
            const float y = w.ellipses[i].pixel_y, height = 1.0001f * radii[2 * i + 1] + 2.0f, limit = w.tiles_y - 1.0f;
            const int top = (int)std::clamp((y - height) / TILE, 0.0f, limit);
            const int bottom = (int)std::clamp((y + height) / TILE, 0.0f, limit);
            w.owners[i] = {0, (uint16_t)owners.first[top], (uint16_t)owners.last[bottom]};
            sum += owners.last[bottom] - owners.first[top];
        });
        extra[t + 1] = sum;
    });
    extra[0] = count;
    for (int t = 0; t < threads; ++t) extra[t + 1] += extra[t];
    run_threads(threads, [&](int t) {
        int64_t next = extra[t];
        each(t, [&](int64_t i) {
            w.owners[i].extra = (uint32_t)next;
            next += w.owners[i].last - w.owners[i].first;
        });
    });
    return extra[threads];
}

// How many rows of tiles up and down from a tile belong to its thread alone: what reaches no further is nobody else's.
struct Alone {
    int above = -1, below = -1;
    Alone(const RowOwners& owners, int row, int thread) {
        while (above < 254 && row - above - 1 >= 0 && owners.first[row - above - 1] == thread) ++above;
        while (below < 254 && row + below + 1 < (int)owners.last.size() && owners.last[row + below + 1] == thread) ++below;
    }
    bool holds(const Hit& hit) const { return hit.above <= above && hit.below <= below; }
};

// Gradients and state of a tile's pixels, by block and lane. FIXED channels, or any number where that is 0.
template <int FIXED>
void load_tile(const Scene& scene, const Camera& camera, const Workspace& w, Thread& t, int64_t tile, int64_t count,
               const float* grad_image, const float* grad_alpha) {
    const int D = FIXED ? FIXED : scene.channels;
    for (int block = 0; block < BLOCKS; ++block) {
        const BlockPlace place(w, tile, block);
        t.last[block] = 0;
        for (int lane = 0; lane < LANES; ++lane) {
            const int64_t kept = (tile * BLOCKS + block) * LANES + lane;
            const bool inside = place.inside(lane);
            const int32_t stop = inside ? (int32_t)std::min<int64_t>(w.stop[kept], count) : 0;
            float* gradient = t.gradient.data() + block * t.plane + lane;
            float behind = 0.0f;
            if (inside) {
                const int64_t pixel = (int64_t)(place.y + lane / 4) * w.width + place.x + lane % 4;
                if (grad_alpha) behind -= grad_alpha[pixel];
                for (int j = 0; j < D; ++j) {
                    const float g = grad_image ? grad_image[pixel * D + j] : 0.0f;
                    gradient[j * LANES] = g;
                    if (camera.background) behind += g * camera.background[j];
                }
            } else {
                for (int j = 0; j < D; ++j) gradient[j * LANES] = 0.0f;
            }
            t.state[block].transmittance[lane] = w.transmittance[kept];
            t.state[block].rest[lane] = w.transmittance[kept] * behind;
            t.state[block].stop[lane] = stop;
            t.last[block] = std::max(t.last[block], stop);
        }
    }
}

// The visits of a chunk, last Gaussian first; returns their number. Blocks whose pixels had all stopped before are left
// out; looking every 16 entries is enough, since the lanes know their own end.
int list_visits(Thread& t, const Hit* hits, int n, int32_t base) {
    uint32_t live = 0;
    int visits = 0;
    for (int i = n - 1; i >= 0; --i) {
        if (i == n - 1 || i % 16 == 15) {
            live = 0;
            for (int block = 0; block < BLOCKS; ++block) live |= (uint32_t)(t.last[block] > base + i / 16 * 16) << block;
        }
        for (uint32_t m = hits[i].blocks & live; m; m &= m - 1) t.visits[visits++] = (uint16_t)(i * BLOCKS + __builtin_ctz(m));
    }
    return visits;
}

struct VisitedOpacity : Opacity {
    Floats inverse;  // of 1 - alpha
    SMPLXPP_INLINE VisitedOpacity(const Thread& t, int visit, int32_t base)
        : Opacity(t.chunk.rows[visit / BLOCKS], load(TILE_PIXELS.x[visit % BLOCKS]), load(TILE_PIXELS.y[visit % BLOCKS]),
                  load(t.state[visit % BLOCKS].stop) > broadcast(base + visit / BLOCKS)),
          inverse(reciprocal(broadcast(1.0f) - alpha)) {}
};

// The channels from D on of one Gaussian, whose visits are [begin, end).
template <int D>
void unblend_more(const Scene& scene, Thread& t, int i, int begin, int end) {
    for (int first = D, group = 1; first < scene.channels; first += LANES, ++group) {
        const int n = std::min(LANES, scene.channels - first);
        Floats more[LANES] = {};
        for (int v = begin; v < end; ++v) {
            const int block = t.visits[v] % BLOCKS;
            const float* gradient = t.gradient.data() + block * t.plane + first * LANES;
            const Floats w = load(t.state[block].weight);
            for (int j = 0; j < n; ++j) more[j] = fma(w, load(gradient + j * LANES), more[j]);
        }
        add_lane_sums(more, t.row[i] + group * LANES);
    }
}

// Adds the sums of a chunk's Gaussians over their visits to their rows. D channels ride in the first group of 16. As in
// blend_block, the opacity of the next visit is begun before the present one is used.
template <int D, bool MORE>
void unblend_visits(const Scene& scene, Thread& t, const Hit* hits, int visits, int32_t base) {
    if (visits == 0) return;
    const Floats alpha_max = broadcast(ALPHA_MAX);
    t.visits[visits] = (uint16_t)(t.visits[visits - 1] ^ BLOCKS);  // another Gaussian: the last one's end is seen
    VisitedOpacity next(t, t.visits[0], base);
    Floats sum[LANES] = {};
    int begin = 0;
    for (int v = 0; v < visits; ++v) {
        const int i = t.visits[v] / BLOCKS, block = t.visits[v] % BLOCKS;
        const VisitedOpacity now = next;
        next = VisitedOpacity(t, t.visits[v + 1], base);
        BlockState& state = t.state[block];
        const float* gradient = t.gradient.data() + block * t.plane;
        const TileRow& row = t.chunk.rows[i];
        const Floats T = load(state.transmittance) * now.inverse, w = now.alpha * T;
        store(state.transmittance, T);
        Floats d = zeros();
        for (int j = 0; j < D; ++j) {
            const Floats g = load(gradient + j * LANES);
            d = fma(g, broadcast(row.channels[j]), d);
            sum[MOMENTS + j] = fma(w, g, sum[MOMENTS + j]);
        }
        if (MORE) {
            const float* features = scene.features + (int64_t)hits[i].gaussian * scene.channels;
            for (int j = D; j < scene.channels; ++j) d = fma(load(gradient + j * LANES), broadcast(features[j]), d);
            store(state.weight, w);
        }
        const Floats S = load(state.rest);
        store(state.rest, fma(w, d, S));
        const Floats v_alpha = where(alpha_max > now.alpha, now.alpha * fnma(S, now.inverse, T * d));
        const Floats vp = v_alpha * now.p, vq = v_alpha * now.q;
        sum[0] = sum[0] + v_alpha;
        sum[1] = sum[1] + vp;
        sum[2] = sum[2] + vq;
        sum[3] = fma(vp, now.p, sum[3]);
        sum[4] = fma(vp, now.q, sum[4]);
        sum[5] = fma(vq, now.q, sum[5]);
        if (t.visits[v + 1] / BLOCKS != i) {
            add_lane_sums(sum, t.row[i]);
            for (Floats& s : sum) s = zeros();
            if (MORE) unblend_more<D>(scene, t, i, begin, v + 1);
            begin = v + 1;
        }
    }
}

template <int D, bool MORE>
void unblend_tile(const Scene& scene, const Camera& camera, const Workspace& w, Thread& t, int thread, int64_t tile,
                  const RowOwners& owners, const float* grad_image, const float* grad_alpha) {
    const int64_t begin = w.tile_start[tile], count = w.tile_start[tile + 1] - begin;
    if (count == 0) return;
    (scene.channels == D ? load_tile<D> : load_tile<0>)(scene, camera, w, t, tile, count, grad_image, grad_alpha);
    const int32_t needed = *std::max_element(t.last, t.last + BLOCKS);
    const float x = (float)((tile % w.tiles_x) * TILE + TILE / 2), y = (float)((tile / w.tiles_x) * TILE + TILE / 2);
    const int64_t stride = (int64_t)LANES * row_groups(scene.channels);
    const Alone alone(owners, (int)(tile / w.tiles_x), thread);
    for (int32_t base = (needed - 1) / CHUNK * CHUNK; base >= 0 && needed; base -= CHUNK) {
        const Hit* hits = w.hits.data() + begin + base;
        const int n = std::min(CHUNK, needed - base);
        t.chunk.gather<D>(scene, w, hits, n, n, x, y);
        for (int i = 0; i < n; ++i) {
            const int64_t row = alone.holds(hits[i]) ? hits[i].gaussian : w.row_of(hits[i].gaussian, thread);
            t.row[i] = w.rows.data() + row * stride;
            __builtin_prefetch(t.row[i], 1);
        }
        unblend_visits<D, MORE>(scene, t, hits, list_visits(t, hits, n, base), base);
    }
}

template <int D, bool MORE>
void unblend_tiles(const Scene& scene, const Camera& camera, Workspace& w, const float* radii, const float* grad_image,
                   const float* grad_alpha, int threads) {
    const std::vector<int64_t> cut = cut_tiles(w, threads);
    const RowOwners owners(w, cut);
    const int64_t rows = assign_rows(scene.count, radii, w, owners, threads), stride = (int64_t)LANES * row_groups(scene.channels);
    w.rows.reserve(rows * stride);
    run_threads(threads, [&](int t) {
        const int64_t begin = rows * t / threads, end = rows * (t + 1) / threads;
        std::fill(w.rows.data() + begin * stride, w.rows.data() + end * stride, 0.0f);
    });
    run_threads(threads, [&](int t) {
        auto thread = std::make_unique<Thread>();
        thread->plane = (int64_t)LANES * std::max<int64_t>(scene.channels, D);
        thread->gradient.reserve(BLOCKS * thread->plane);
        std::fill(thread->gradient.data(), thread->gradient.data() + thread->gradient.capacity(), 0.0f);
        for (int64_t tile = cut[t]; tile < cut[t + 1]; ++tile) {
            unblend_tile<D, MORE>(scene, camera, w, *thread, t, tile, owners, grad_image, grad_alpha);
        }
    });
}

}  // namespace

void unblend(const Scene& scene, const Camera& camera, Workspace& w, const float* radii, const float* grad_image,
             const float* grad_alpha, int threads) {
    const int D = scene.channels;
    if (D <= 3) return unblend_tiles<3, false>(scene, camera, w, radii, grad_image, grad_alpha, threads);
    if (D <= 7) return unblend_tiles<7, false>(scene, camera, w, radii, grad_image, grad_alpha, threads);
    if (D <= ROW_CHANNELS) return unblend_tiles<ROW_CHANNELS, false>(scene, camera, w, radii, grad_image, grad_alpha, threads);
    return unblend_tiles<ROW_CHANNELS, true>(scene, camera, w, radii, grad_image, grad_alpha, threads);
}

}  // namespace smplxpp::gaussian
