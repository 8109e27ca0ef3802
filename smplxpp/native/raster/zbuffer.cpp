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

// `screen` holds x, y in pixels (pixel centres at +0.5), z, and the interpolation weight (1/z for perspective,
// 1 for orthographic) of each vertex, in double: edge functions of slivers lose their sign in float. Faces come in
// `order`; without one all of them do.
void raster_rows(const double* screen, const int32_t* faces, int64_t first, int64_t last, const int32_t* order,
                 double near, int y_begin, int y_end, const Target& t) {
    for (int64_t k = first; k < last; ++k) {
        const int32_t f = order ? order[k] : int32_t(k);
        const double* a = screen + 4 * size_t(faces[3 * size_t(f)]);
        const double* b = screen + 4 * size_t(faces[3 * size_t(f) + 1]);
        const double* c = screen + 4 * size_t(faces[3 * size_t(f) + 2]);
        if (a[2] <= near || b[2] <= near || c[2] <= near || (!order && !on_screen(a, b, c))) continue;
        const Box box(a, b, c, t.width, t.height);
        if (box.x0 > box.x1 || box.y0 > box.y1) continue;
        const double area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
        if (area == 0.0) continue;
        const int y0 = std::max(y_begin, box.y0), y1 = std::min(y_end - 1, box.y1);
        const double inv = 1.0 / area;
        const double ax = (b[1] - c[1]) * inv, ay = (c[0] - b[0]) * inv;
        const double bx = (c[1] - a[1]) * inv, by = (a[0] - c[0]) * inv;
        for (int y = y0; y <= y1; ++y) {
            const double py = y + 0.5 - c[1], ya = ay * py, yb = by * py;
            for (int x = box.x0; x <= box.x1; x += kLanes) {
                const Lanes px = (kLane + double(x)) + 0.5 - c[0];
                const Lanes wa = ax * px + ya, wb = bx * px + yb, wc = 1.0 - wa - wb;
                const Flags outside = (wa < 0.0) | (wb < 0.0) | (wc < 0.0);
                if ((outside[0] & outside[1] & outside[2] & outside[3]) != 0) continue;
                const Lanes qa = wa * a[3], qb = wb * b[3], qc = wc * c[3], q = 1.0 / (qa + qb + qc);
                const Lanes depth = (qa * a[2] + qb * b[2] + qc * c[2]) * q;
                const int lanes = std::min(kLanes, box.x1 - x + 1);  // those beyond the box are left out
                for (int k = 0; k < lanes; ++k) {
                    const float z = float(depth[k]);
                    const size_t i = size_t(y) * t.width + x + k;
                    if (outside[k] || !(z < t.depth[i])) continue;
                    t.depth[i] = z;
                    t.face_id[i] = f;
                    t.barycentric[3 * i] = float(qa[k] * q[k]);
                    t.barycentric[3 * i + 1] = float(qb[k] * q[k]);
                    t.barycentric[3 * i + 2] = float(qc[k] * q[k]);
                }
            }
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
        raster_rows(screen, faces, 0, face_count, nullptr, near, 0, height, target);
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
            raster_rows(screen, faces, start[size_t(b)], start[size_t(b) + 1], order.data(), near, y0, y1, target);
        }
    });
}); }
