// Maps of vertex values over a rasterised mesh, and their gradients.
//
// A pixel knows its face (-1 = background) and the barycentrics of the point it sees. Pixels are dealt to threads in chunks
// by index; gradients of vertices are summed per thread, then over the threads in order: the same bits every time at one
// number of threads.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "common/parallel.hpp"

namespace {

constexpr int64_t kChunk = 4096; // pixels

// work(first, last, thread) for the chunks of 0 .. count-1.
template <class Work>
void deal(int64_t count, int threads, Work&& work) {
    smplxpp::run_threads(threads, [&](int thread) {
        for (int64_t first = thread * kChunk; first < count; first += threads * kChunk)
            work(first, std::min(count, first + kChunk), thread);
    });
}

// `out` (size) = sum over the threads of what work(first, last, sum) adds to its own zeroed `sum`.
template <class Value, class Work>
void deal_and_sum(int64_t count, int threads, int64_t size, Value* out, Work&& work) {
    std::vector<std::vector<Value>> sums(static_cast<size_t>(threads));
    deal(count, threads, [&](int64_t first, int64_t last, int thread) {
        auto& sum = sums[size_t(thread)];
        if (sum.empty()) sum.resize(size_t(size));
        work(first, last, sum.data());
    });
    std::fill_n(out, size, Value(0));
    deal(size, threads, [&](int64_t first, int64_t last, int) {
        for (const auto& sum : sums)
            if (!sum.empty())
                for (int64_t i = first; i < last; ++i) out[i] += sum[size_t(i)];
    });
}

struct Vec {
    double x, y, z;
    friend Vec operator*(double s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
    friend Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
};
Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

}  // namespace

// out (pixels, D) = values (V, D) at the barycentrics; 0 on the background. Faces (F, 3) and face ids are looked at.
SMPLXPP_EXPORT int32_t smplxpp_interpolate(
    const float* values, const int32_t* faces, const int32_t* face_id, const float* barycentric, int64_t pixels,
    int64_t V, int64_t F, int64_t D, float* out, int threads) { return smplxpp::guarded([&] {
    smplxpp::check_indices(faces, 3 * F, V);
    deal(pixels, threads, [&](int64_t first, int64_t last, int) {
        for (int64_t i = first; i < last; ++i) {
            float* __restrict o = out + i * D;
            if (face_id[i] < 0) {
                std::fill_n(o, D, 0.0f);
                continue;
            }
            if (face_id[i] >= F) throw std::out_of_range("face");
            const int32_t* corner = faces + 3 * int64_t(face_id[i]);
            const float *a = values + corner[0] * D, *b = values + corner[1] * D, *c = values + corner[2] * D;
            const float u = barycentric[3 * i], v = barycentric[3 * i + 1], w = barycentric[3 * i + 2];
            for (int64_t d = 0; d < D; ++d) o[d] = u * a[d] + v * b[d] + w * c[d];
        }
    });
}); }

// Gradient of `out` above to values (V, D), where grad_values is given, and to the barycentrics, where grad_barycentric is.
SMPLXPP_EXPORT int32_t smplxpp_interpolate_backward(
    const float* values, const int32_t* faces, const int32_t* face_id, const float* barycentric, const float* grad_out,
    int64_t pixels, int64_t V, int64_t D, float* grad_values, float* grad_barycentric, int threads) { return smplxpp::guarded([&] {
    const auto by_corner = [&](int64_t first, int64_t last, auto&& visit) {
        for (int64_t i = first; i < last; ++i)
            if (face_id[i] >= 0)
                for (int k = 0; k < 3; ++k) visit(3 * i + k, faces[3 * int64_t(face_id[i]) + k] * D, grad_out + i * D);
    };
    if (grad_values) {
        deal_and_sum(pixels, threads, V * D, grad_values, [&](int64_t first, int64_t last, float* sum) {
            by_corner(first, last, [&](int64_t i, int64_t vertex, const float* g) {
                for (int64_t d = 0; d < D; ++d) sum[vertex + d] += barycentric[i] * g[d];
            });
        });
    }
    if (grad_barycentric) {
        deal(pixels, threads, [&](int64_t first, int64_t last, int) {
            std::fill(grad_barycentric + 3 * first, grad_barycentric + 3 * last, 0.0f);
            by_corner(first, last, [&](int64_t i, int64_t vertex, const float* g) {
                float s = 0;
                for (int64_t d = 0; d < D; ++d) s += values[vertex + d] * g[d];
                grad_barycentric[i] = s;
            });
        });
    }
}); }

// Gradient of barycentrics and depth (each may be null) to the corners `points` (V,3) in the camera's frame, at fixed
// pixels and faces. `ray_from_pixel` is the row-major inverse of the intrinsics. With r the ray of the pixel and a, b, c the
// corners (their z replaced by 1 for parallel rays), w_a = r . (b x c) and so on, the barycentrics are w / sum(w).
SMPLXPP_EXPORT int32_t smplxpp_barycentric_backward(
    const double* points, const int32_t* faces, const int32_t* face_id, const float* grad_barycentric,
    const float* grad_depth, const double* ray_from_pixel, int orthographic, int width, int64_t pixels, int64_t V,
    double* grad_points, int threads) { return smplxpp::guarded([&] {
    const double* m = ray_from_pixel;
    deal_and_sum(pixels, threads, 3 * V, grad_points, [&](int64_t first, int64_t last, double* sum) {
        for (int64_t i = first; i < last; ++i) {
            if (face_id[i] < 0) continue;
            const int32_t* corner = faces + 3 * int64_t(face_id[i]);
            const double px = double(i % width) + 0.5, py = double(i / width) + 0.5;
            const Vec r{m[0] * px + m[1] * py + m[2], m[3] * px + m[4] * py + m[5], m[6] * px + m[7] * py + m[8]};
            Vec p[3];
            double z[3], w[3], g[3];
            for (int k = 0; k < 3; ++k) {
                const double* q = points + 3 * int64_t(corner[k]);
                z[k] = q[2];
                p[k] = {q[0], q[1], orthographic ? 1.0 : q[2]};
            }
            for (int k = 0; k < 3; ++k) w[k] = dot(r, cross(p[(k + 1) % 3], p[(k + 2) % 3]));
            const double total = w[0] + w[1] + w[2];
            if (total == 0) continue;
            const double gz = grad_depth ? double(grad_depth[i]) : 0.0;
            double mean = 0;
            for (int k = 0; k < 3; ++k) {
                w[k] /= total;
                g[k] = (grad_barycentric ? double(grad_barycentric[3 * i + k]) : 0.0) + gz * z[k];
                mean += w[k] * g[k];
            }
            for (int k = 0; k < 3; ++k) g[k] = (g[k] - mean) / total; // now the gradient to the unnormalised weights
            for (int k = 0; k < 3; ++k) {
                const int l = (k + 1) % 3, n = (k + 2) % 3;
                const Vec by = cross(r, g[l] * p[n] - g[n] * p[l]);
                double* s = sum + 3 * int64_t(corner[k]);
                s[0] += by.x, s[1] += by.y;
                s[2] += (orthographic ? 0.0 : by.z) + gz * w[k];
            }
        }
    });
}); }
