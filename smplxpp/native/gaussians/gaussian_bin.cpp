// Lists of Gaussians by tile, front to back: each thread walks its share of the depth order and notes (tile, Gaussian,
// blocks); a counting sort by tile that takes the threads' notes in turn keeps the order, whatever their number.
#include <algorithm>
#include <cmath>

#include "gaussians/gaussian.hpp"
#include "common/parallel.hpp"
#include "common/simd.hpp"

namespace smplxpp::gaussian {

namespace {

constexpr int STRIPS = LANES;   // strips of BLOCK rows that are looked at together
constexpr int STRIPS_PER_TILE = TILE / BLOCK;
constexpr int AHEAD = 16;       // Gaussians whose ellipse is fetched into the cache before its turn

// Columns of blocks [first, last] that the ellipse touches in each of 16 strips from `strip` on; first > last where none.
struct Columns {
    alignas(64) int32_t first[STRIPS], last[STRIPS];
};

// The exact outline p^2 + q^2 = reach at the pixel centres of a strip, y in [top, bottom] of the mean: x runs to
//   (-b y +- sqrt(reach - c^2 y^2)) / a,
// largest at y_right (smallest at -y_right) or at the end of the strip next to it. Widened by `slack` against rounding:
// the blend tests each pixel.
struct Outline {
    float b, c, inv_a, reach, x, y, half_height, y_right, slack;

    explicit Outline(const Ellipse& e) : b(e.b), c(e.c), inv_a(1.0f / e.a), reach(e.log_opacity - LOG2_ALPHA_MIN) {
        x = e.pixel_x + e.rest_x;
        y = e.pixel_y + e.rest_y;
        const float inv_c = 1.0f / c, radius = std::sqrt(reach), length2 = c * c + b * b, inv_length = 1.0f / std::sqrt(length2);
        slack = 1e-3f + 4e-6f * radius * (inv_c + length2 * inv_length * inv_c * inv_a);
        half_height = radius * inv_c + slack;
        y_right = -b * radius * inv_length * inv_c;
    }

    void columns(int strip, int width, Columns& out) const {
        alignas(64) static const float index[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
        const Floats zero = zeros(), edge = broadcast(half_height);
        const Floats first_row = fma(load(index), broadcast((float)BLOCK), broadcast(BLOCK * strip + 0.5f - y));
        const Floats top = max(first_row, zero - edge), bottom = min(first_row + broadcast(BLOCK - 1.0f), edge);
        const Floats right_y = min(max(broadcast(y_right), top), bottom);
        const Floats left_y = min(max(broadcast(-y_right), top), bottom);
        const Floats right_q = broadcast(c) * right_y, left_q = broadcast(c) * left_y;
        const Floats right_p = square_root(max(fnma(right_q, right_q, broadcast(reach)), zero));
        const Floats left_p = square_root(max(fnma(left_q, left_q, broadcast(reach)), zero));
        const Floats right = fma(fnma(broadcast(b), right_y, right_p), broadcast(inv_a), broadcast(x - 0.5f + slack));
        const Floats left = fnma(fma(broadcast(b), left_y, left_p), broadcast(inv_a), broadcast(x + 0.5f - slack));
        // Pixels of the strip from ceil(left) to floor(right); truncation is floor for what is not negative.
        const Ints first = truncated(min(max(left, zero), broadcast((float)width)));
        const Ints last = truncated(min(max(right, zero), broadcast(width - 1.0f)));
        const Mask some = without((bottom >= top) & (right >= zero), first > last);
        store(out.first, where(some, shifted_right(first, 2), broadcast(1 << 28)));
        store(out.last, where(some, shifted_right(last, 2), broadcast(-1)));
    }
};

// Appends the tiles of one tile row, four strips of columns, to the notes.
inline Workspace::Emission* emit_tile_row(const int32_t* first, const int32_t* last, int64_t tile_row, Hit hit,
                                          int32_t* histogram, Workspace::Emission* out) {
    const int begin = std::min(std::min(first[0], first[1]), std::min(first[2], first[3])) / STRIPS_PER_TILE;
    const int end = std::max(std::max(last[0], last[1]), std::max(last[2], last[3]));
    if (end < 0) return out;
    for (int segment = begin; segment <= end / STRIPS_PER_TILE; segment += 16) {  // 16 tiles, 64 columns of blocks: one word a strip
        uint64_t bits[STRIPS_PER_TILE], all = 0;
        for (int r = 0; r < STRIPS_PER_TILE; ++r) {
            const int lo = std::max(first[r] - segment * 4, 0), hi = std::min(last[r] - segment * 4, 63);
            bits[r] = lo <= hi ? ((2ull << (hi - lo)) - 1) << lo : 0;
            all |= bits[r];
        }
        for (int64_t tile = tile_row + segment; all; ++tile, all >>= 4) {
            hit.blocks = (uint16_t)((bits[0] & 15) | (bits[1] & 15) << 4 | (bits[2] & 15) << 8 | (bits[3] & 15) << 12);
            for (uint64_t& b : bits) b >>= 4;
            if (!hit.blocks) continue;
            *out++ = {(uint32_t)tile, hit};
            ++histogram[tile];
        }
    }
    return out;
}

// Calls visit(columns.first, columns.last, row of tiles, hit) for the Gaussians [begin, end) of the depth order, front to back,
// and the rows of tiles that each may touch.
template <class Visit>
void visit_rows(const Workspace& w, int64_t begin, int64_t end, Visit&& visit) {
    Columns columns;
    for (int64_t k = begin; k < end; ++k) {
        if (k + AHEAD < end) __builtin_prefetch(&w.ellipses[(uint32_t)w.order[k + AHEAD]]);
        const uint32_t gaussian = (uint32_t)w.order[k];
        const Outline outline(w.ellipses[gaussian]);
        // Rows whose centre lies within the outline, clamped as floats: an int would overflow.
        const float top = std::max(outline.y - outline.half_height - 0.5f, 0.0f);
        const float bottom = std::min(outline.y + outline.half_height - 0.5f, w.height - 1.0f);
        if (!(top <= bottom)) continue;
        const int first_row = (int)top / TILE, last_row = (int)bottom / TILE, last_strip = (int)bottom / BLOCK;
        for (int strip = first_row * STRIPS_PER_TILE; strip <= last_strip; strip += STRIPS) {
            outline.columns(strip, w.width, columns);
            for (int r = 0; r < STRIPS && strip + r <= last_strip; r += STRIPS_PER_TILE) {
                const int row = (strip + r) / STRIPS_PER_TILE;
                const Hit hit = {gaussian, 0, (uint8_t)std::min(row - first_row, 255), (uint8_t)std::min(last_row - row, 255)};
                visit(columns.first + r, columns.last + r, row, hit);
            }
        }
    }
}

// Tiles in the boxes of the Gaussians: no fewer than their lists have entries, and quickly counted.
double tiles_in_boxes(int64_t count, const float* radii, const Workspace& w) {
    double sum = 0;
    for (int64_t i = 0; i < count; ++i) {
        const float across = std::min(radii[2 * i] / (TILE / 2) + 2.0f, (float)w.tiles_x);
        const float down = std::min(radii[2 * i + 1] / (TILE / 2) + 2.0f, (float)w.tiles_y);
        sum += radii[2 * i] > 0 ? across * down : 0.0f;
    }
    return sum;
}

// Entries that the lists will have.
int64_t count_entries(const Workspace& w, int threads) {
    std::vector<int64_t> counted(threads, 0);
    run_threads(threads, [&](int t) {
        int64_t sum = 0;
        visit_rows(w, w.visible * t / threads, w.visible * (t + 1) / threads, [&](const int32_t* first, const int32_t* last, int, Hit) {
            const int begin = std::min(std::min(first[0], first[1]), std::min(first[2], first[3])) / STRIPS_PER_TILE;
            const int end = std::max(std::max(last[0], last[1]), std::max(last[2], last[3]));
            if (end >= 0) sum += end / STRIPS_PER_TILE - begin + 1;
        });
        counted[t] = sum;
    });
    int64_t sum = 0;
    for (int64_t share : counted) sum += share;
    return sum;
}

}  // namespace

// Throws OverLimit where the lists would have more than `most_hits` entries: large Gaussians, many of them, fill any memory.
void bin(Workspace& w, int64_t count, const float* radii, int64_t most_hits, int threads) {
    if (tiles_in_boxes(count, radii, w) > (double)most_hits && count_entries(w, threads) > most_hits) throw OverLimit();
    const int64_t tiles = w.tiles();
    if (w.emissions.size() < (size_t)threads) w.emissions.resize(threads);
    std::vector<int64_t> emitted(threads);
    int32_t* counts = w.counts.reserve(threads * tiles);
    run_threads(threads, [&](int t) {
        int32_t* histogram = counts + t * tiles;
        std::fill(histogram, histogram + tiles, 0);
        Buffer<Workspace::Emission>& notes = w.emissions[t];
        int64_t used = 0;
        const auto emit = [&](const int32_t* first, const int32_t* last, int row, Hit hit) {
            Workspace::Emission* out = notes.grow(used + w.tiles_x, used) + used;
            used = emit_tile_row(first, last, (int64_t)row * w.tiles_x, hit, histogram, out) - notes.data();
        };
        visit_rows(w, w.visible * t / threads, w.visible * (t + 1) / threads, emit);
        emitted[t] = used;
    });
    int64_t* start = w.tile_start.reserve(tiles + 1);
    int64_t* place = w.histogram.reserve(threads * tiles);
    int64_t sum = 0;
    for (int64_t tile = 0; tile < tiles; ++tile) {
        start[tile] = sum;
        for (int t = 0; t < threads; ++t) {
            place[t * tiles + tile] = sum;
            sum += counts[t * tiles + tile];
        }
    }
    start[tiles] = sum;
    Hit* hits = w.hits.reserve(sum);
    run_threads(threads, [&](int t) {
        int64_t* next = place + t * tiles;
        const Workspace::Emission* notes = w.emissions[t].data();
        for (int64_t i = 0; i < emitted[t]; ++i) hits[next[notes[i].tile]++] = notes[i].hit;
    });
}

}  // namespace smplxpp::gaussian
