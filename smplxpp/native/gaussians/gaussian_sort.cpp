// Depth order of the visible Gaussians: a stable radix sort, so that equal depths keep the order of their indices.
#include <algorithm>
#include <cstring>

#include "gaussians/gaussian.hpp"
#include "common/parallel.hpp"

namespace smplxpp::gaussian {

namespace {

constexpr int MAX_DIGIT_BITS = 11;

// Depths are positive, so their bits rise as they do.
inline uint32_t depth_bits(float depth) {
    uint32_t bits;
    std::memcpy(&bits, &depth, sizeof bits);
    return bits;
}

struct Share {
    int64_t begin, end;
};
inline Share share(int64_t n, int thread, int threads) { return {n * thread / threads, n * (thread + 1) / threads}; }

}  // namespace

void sort_by_depth(int64_t count, const float* depths, const float* radii, Workspace& w, int threads) {
    threads = threads_for(count, threads);
    struct Found {
        int64_t visible = 0;
        uint32_t low = ~0u, high = 0;
        char pad[48];
    };
    std::vector<Found> found(threads);
    run_threads(threads, [&](int t) {
        Found f;
        for (int64_t i = share(count, t, threads).begin; i < share(count, t, threads).end; ++i) {
            if (radii[2 * i] <= 0) continue;
            const uint32_t bits = depth_bits(depths[i]);
            ++f.visible;
            f.low = std::min(f.low, bits);
            f.high = std::max(f.high, bits);
        }
        found[t] = f;
    });
    int64_t visible = 0;
    uint32_t low = ~0u, high = 0;
    for (Found& f : found) {
        low = std::min(low, f.low);
        high = std::max(high, f.high);
        visible += std::exchange(f.visible, visible);  // now where the thread's share begins
    }
    w.visible = visible;
    uint64_t *from = w.keys.reserve(visible + 1), *to = w.sorted.reserve(visible + 1);
    run_threads(threads, [&](int t) {
        uint64_t* out = from + found[t].visible;
        for (int64_t i = share(count, t, threads).begin; i < share(count, t, threads).end; ++i) {
            if (radii[2 * i] > 0) *out++ = (uint64_t)(depth_bits(depths[i]) - low) << 32 | (uint32_t)i;
        }
    });
    const int bits = high > low ? 32 - __builtin_clz(high - low) : 0;
    const int passes = (bits + MAX_DIGIT_BITS - 1) / MAX_DIGIT_BITS, digit_bits = passes ? (bits + passes - 1) / passes : 0;
    const int digits = 1 << digit_bits;
    int64_t* histogram = w.histogram.reserve((int64_t)threads * digits);
    for (int pass = 0, shift = 32; pass < passes; ++pass, shift += digit_bits) {
        run_threads(threads, [&](int t) {
            int64_t* h = histogram + (int64_t)t * digits;
            std::fill(h, h + digits, 0);
            const Share s = share(visible, t, threads);
            for (int64_t i = s.begin; i < s.end; ++i) ++h[(from[i] >> shift) & (digits - 1)];
        });
        int64_t sum = 0;
        for (int d = 0; d < digits; ++d) {
            for (int t = 0; t < threads; ++t) sum += std::exchange(histogram[(int64_t)t * digits + d], sum);
        }
        run_threads(threads, [&](int t) {
            int64_t* h = histogram + (int64_t)t * digits;
            const Share s = share(visible, t, threads);
            for (int64_t i = s.begin; i < s.end; ++i) to[h[(from[i] >> shift) & (digits - 1)]++] = from[i];
        });
        std::swap(from, to);
    }
    w.order = from;
}

}  // namespace smplxpp::gaussian
