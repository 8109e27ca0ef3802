// Z-buffer triangle rasteriser: face id, barycentrics and depth of the nearest face at every pixel centre.
//
// Rows are dealt to threads in interleaved bands and every band visits the faces in index order with a strict
// depth test, so the result does not depend on the number of threads. On equal depth the lower face index wins. One
// thread alone draws all rows in one pass, because sorting faces into bands takes as long as drawing small ones.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#ifdef __AVX__
#include <immintrin.h>
#endif

#include "common/parallel.hpp"

namespace {

constexpr int kBandRows = 8;

// Neighbouring pixels of a row are computed at once, each as it would be alone, to the bit.
constexpr int kLanes = 4;
typedef double Lanes __attribute__((vector_size(32)));
typedef int64_t Flags __attribute__((vector_size(32)));
constexpr Lanes kLane = {0.0, 1.0, 2.0, 3.0};

struct Target {
    int width, height;
    int32_t* face_id;   // (H,W), -1 = background
    float* barycentric; // (H,W,3), of the face's three corners, perspective-correct; 0 on the background
    float* depth;       // (H,W), +inf = background
};

// First pixel whose centre is at or after v, last one at or before it; within [-1, size]. Without std::ceil, which is a
// call on baseline x86-64. NaN gives an empty range.
int first_pixel(double v, int size) {
    if (!(v > -0.5)) return v <= -0.5 ? 0 : size;
    if (v > size) return size;
    const int i = int(v - 0.5 + 1.0) - 1;
    return i + (i + 0.5 < v);
}
int last_pixel(double v, int size) {
    if (!(v >= 0.5)) return -1;
    if (v > size) return size - 1;
    return std::min(size - 1, int(v - 0.5));
}

void clear_band(const Target& t, int y0, int y1) {
    const size_t begin = size_t(y0) * t.width, end = size_t(y1) * t.width;
    std::fill(t.face_id + begin, t.face_id + end, -1);
    std::fill(t.barycentric + 3 * begin, t.barycentric + 3 * end, 0.0f);
    std::fill(t.depth + begin, t.depth + end, std::numeric_limits<float>::infinity());
}

// Pixels whose centres lie in the box of three corners; empty where x0 > x1 or y0 > y1.
struct Box {
    int x0, x1, y0, y1;
    Box(const double* a, const double* b, const double* c, int width, int height)
        : x0(first_pixel(std::min({a[0], b[0], c[0]}), width)), x1(last_pixel(std::max({a[0], b[0], c[0]}), width)),
          y0(first_pixel(std::min({a[1], b[1], c[1]}), height)), y1(last_pixel(std::max({a[1], b[1], c[1]}), height)) {}
};

// Whether all coordinates in the image are finite; they are not at a corner on the camera's plane.
bool on_screen(const double* a, const double* b, const double* c) {
    return std::isfinite(a[0] + b[0] + c[0] + a[1] + b[1] + c[1]);
}

// Which of the lanes are set, one bit a lane.
unsigned bits_of(const Flags& flags) {
#ifdef __AVX__
    return unsigned(_mm256_movemask_pd(__m256d(flags)));
#else
    unsigned bits = 0;
    for (int k = 0; k < kLanes; ++k) bits |= unsigned(flags[k] & 1) << k;
    return bits;
#endif
}

// Draws face f with the corners a, b and c in the rows and columns of the box.
void draw_face(int32_t f, const double* a, const double* b, const double* c, int x0, int x1, int y0, int y1,
               const Target& t) {
    const double area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    if (area == 0.0) return;
    const double inv = 1.0 / area;
    const double ax = (b[1] - c[1]) * inv, ay = (c[0] - b[0]) * inv;
    const double bx = (c[1] - a[1]) * inv, by = (a[0] - c[0]) * inv;
    for (int y = y0; y <= y1; ++y) {
        const double py = y + 0.5 - c[1], ya = ay * py, yb = by * py;
        for (int x = x0; x <= x1; x += kLanes) {
            const Lanes px = (kLane + double(x)) + 0.5 - c[0];
            const Lanes wa = ax * px + ya, wb = bx * px + yb, wc = 1.0 - wa - wb;
            const int lanes = std::min(kLanes, x1 - x + 1);  // those beyond the box are left out
            unsigned drawn = ~bits_of((wa < 0.0) | (wb < 0.0) | (wc < 0.0)) & ((1u << lanes) - 1u);
            if (!drawn) continue;
            const Lanes qa = wa * a[3], qb = wb * b[3], qc = wc * c[3], q = 1.0 / (qa + qb + qc);
            const Lanes depth = (qa * a[2] + qb * b[2] + qc * c[2]) * q;
            const Lanes sa = qa * q, sb = qb * q, sc = qc * q;
            for (; drawn; drawn &= drawn - 1) {
                const int k = __builtin_ctz(drawn);
                const float z = float(depth[k]);
                const size_t i = size_t(y) * t.width + x + k;
                if (!(z < t.depth[i])) continue;
                t.depth[i] = z;
                t.face_id[i] = f;
                t.barycentric[3 * i] = float(sa[k]);
                t.barycentric[3 * i + 1] = float(sb[k]);
                t.barycentric[3 * i + 2] = float(sc[k]);
            }
        }
    }
}

// Draws the faces of one band, which come in `order`. `screen` holds x, y in pixels (pixel centres at +0.5), z, and the
// interpolation weight (1/z for perspective, 1 for orthographic) of each vertex, in double: edge functions of slivers
// lose their sign in float.
void raster_band(const double* screen, const int32_t* faces, int64_t first, int64_t last, const int32_t* order,
                 double near, int y_begin, int y_end, const Target& t) {
    for (int64_t k = first; k < last; ++k) {
        const int32_t f = order[k];
        const double* a = screen + 4 * size_t(faces[3 * size_t(f)]);
        const double* b = screen + 4 * size_t(faces[3 * size_t(f) + 1]);
        const double* c = screen + 4 * size_t(faces[3 * size_t(f) + 2]);
        if (a[2] <= near || b[2] <= near || c[2] <= near) continue;
        const Box box(a, b, c, t.width, t.height);
        if (box.x0 > box.x1) continue;
        draw_face(f, a, b, c, box.x0, box.x1, std::max(y_begin, box.y0), std::min(y_end - 1, box.y1), t);
    }
}

// Draws all faces. The boxes of a block of faces are computed without a branch, because most of the time of small faces
// would go into branches that no processor foresees; `Box` computes the same pixels.
void raster_all(const double* screen, const int32_t* faces, int64_t count, double near, const Target& t) {
    constexpr int kBlock = 64;
    double low_x[kBlock], high_x[kBlock], low_y[kBlock], high_y[kBlock];
    int x0[kBlock], x1[kBlock], y0[kBlock], y1[kBlock], kept[kBlock];
    const double width = t.width, height = t.height;
    const auto first = [](double v) {
        const int i = int(v - 0.5 + 1.0) - 1;
        return i + (i + 0.5 < v);
    };
    const auto last = [](double v) {
        const int i = int(v + 0.5) - 1;
        return i - (i + 0.5 > v);
    };
    const auto corner = [&](int64_t f, int k) { return screen + 4 * size_t(faces[3 * size_t(f) + size_t(k)]); };
    for (int64_t begin = 0; begin < count; begin += kBlock) {
        const int n = int(std::min<int64_t>(kBlock, count - begin));
        for (int k = 0; k < n; ++k) {
            const double *a = corner(begin + k, 0), *b = corner(begin + k, 1), *c = corner(begin + k, 2);
            const bool out = (a[2] <= near) | (b[2] <= near) | (c[2] <= near) | !on_screen(a, b, c);
            // A face that is left out has an empty box.
            low_x[k] = out ? 1.0 : std::min({a[0], b[0], c[0]});
            high_x[k] = out ? 0.0 : std::max({a[0], b[0], c[0]});
            low_y[k] = out ? 1.0 : std::min({a[1], b[1], c[1]});
            high_y[k] = out ? 0.0 : std::max({a[1], b[1], c[1]});
        }
        for (int k = 0; k < n; ++k) {
            x0[k] = first(std::min(std::max(low_x[k], 0.0), width));
            x1[k] = last(std::min(std::max(high_x[k], -0.5), width));
            y0[k] = first(std::min(std::max(low_y[k], 0.0), height));
            y1[k] = last(std::min(std::max(high_y[k], -0.5), height));
        }
        int kept_count = 0;
        for (int k = 0; k < n; ++k) {
            kept[kept_count] = k;
            kept_count += (x0[k] <= x1[k]) & (y0[k] <= y1[k]);
        }
        for (int m = 0; m < kept_count; ++m) {
            const int k = kept[m];
            const int64_t f = begin + k;
            draw_face(int32_t(f), corner(f, 0), corner(f, 1), corner(f, 2), x0[k], x1[k], y0[k], y1[k], t);
        }
    }
}

}  // namespace

SMPLXPP_EXPORT int32_t smplxpp_zbuffer(
    const double* screen, const int32_t* faces, int64_t face_count, double near, int width, int height,
    int32_t* face_id, float* barycentric, float* depth, int threads) { return smplxpp::guarded([&] {
    const Target target{width, height, face_id, barycentric, depth};
    if (threads == 1) {
        clear_band(target, 0, height);
        raster_all(screen, faces, face_count, near, target);
        return;
    }
    const int bands = (height + kBandRows - 1) / kBandRows;

    // Faces of each band, in index order (counting sort): small faces are touched by one band alone, and those that cover no
    // pixel centre by none. Each thread sorts one run of faces and counts in memory of its own, lines away from the others'.
    struct Span { int32_t first = 0, last = -1; };
    std::vector<Span> spans(static_cast<size_t>(face_count));
    const size_t stride = size_t(bands) + 16;
    std::vector<int64_t> cursor(stride * size_t(threads), 0), start(size_t(bands) + 1);
    const auto cell = [&](int band, int run) { return size_t(run) * stride + size_t(band); };
    const auto run_begin = [&](int run) { return face_count * run / threads; };
    smplxpp::run_threads(threads, [&](int run) {
        for (int64_t f = run_begin(run); f < run_begin(run + 1); ++f) {
            const double* a = screen + 4 * size_t(faces[3 * size_t(f)]);
            const double* b = screen + 4 * size_t(faces[3 * size_t(f) + 1]);
            const double* c = screen + 4 * size_t(faces[3 * size_t(f) + 2]);
            if (!on_screen(a, b, c)) continue;
            const Box box(a, b, c, width, height);
            if (box.y0 > box.y1 || box.x0 > box.x1) continue;
            spans[size_t(f)] = {box.y0 / kBandRows, box.y1 / kBandRows};
            for (int k = spans[size_t(f)].first; k <= spans[size_t(f)].last; ++k) ++cursor[cell(k, run)];
        }
    });
    int64_t sum = 0;
    for (int b = 0; b < bands; ++b) {
        start[size_t(b)] = sum;
        for (int run = 0; run < threads; ++run) sum += std::exchange(cursor[cell(b, run)], sum);
    }
    start.back() = sum;
    std::vector<int32_t> order(static_cast<size_t>(sum));
    smplxpp::run_threads(threads, [&](int run) {
        for (int64_t f = run_begin(run); f < run_begin(run + 1); ++f)
            for (int k = spans[size_t(f)].first; k <= spans[size_t(f)].last; ++k)
                order[size_t(cursor[cell(k, run)]++)] = int32_t(f);
    });

    smplxpp::run_threads(threads, [&](int thread) {
        for (int b = thread; b < bands; b += threads) {
            const int y0 = b * kBandRows, y1 = std::min(height, y0 + kBandRows);
            clear_band(target, y0, y1);
            raster_band(screen, faces, start[size_t(b)], start[size_t(b) + 1], order.data(), near, y0, y1, target);
        }
    });
}); }
