// Three-vectors, 3x3 row-major matrices, and how Gaussians of a mesh are dealt to threads.
#pragma once
#include <cmath>
#include <cstdint>
#include <vector>

#include "common/parallel.hpp"

namespace smplxpp::binding {

struct Vec {
    float x, y, z;
};
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(float s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline float length(Vec a) { return std::sqrt(dot(a, a)); }
inline Vec load(const float* p) { return {p[0], p[1], p[2]}; }
inline Vec load_or_zero(const float* p, int64_t i) { return p ? load(p + 3 * i) : Vec{0, 0, 0}; }
inline void store(float* p, Vec a) { p[0] = a.x, p[1] = a.y, p[2] = a.z; }
inline void add(float* p, Vec a) { p[0] += a.x, p[1] += a.y, p[2] += a.z; }
inline Vec column(const float* m, int k) { return {m[k], m[3 + k], m[6 + k]}; }
inline Vec turn(const float* m, Vec v) { return v.x * column(m, 0) + v.y * column(m, 1) + v.z * column(m, 2); }
inline Vec turn_back(const float* m, Vec v) { return v.x * load(m) + v.y * load(m + 3) + v.z * load(m + 6); }
// m += a b^T
inline void add_outer(float* m, Vec a, Vec b) { add(m, a.x * b), add(m + 3, a.y * b), add(m + 6, a.z * b); }
// Gradient to v of a function of v / |v|, from its gradient g to the unit vector u.
inline Vec unit_gradient(Vec g, Vec u, float norm) { return (1.0f / norm) * (g - dot(g, u) * u); }

inline int64_t share(int64_t count, int thread, int threads) { return count * thread / threads; }

// Ranges of faces with about equally many Gaussians each: threads + 1 bounds.
inline std::vector<int64_t> face_bounds(const int64_t* face, int64_t N, int64_t F, int threads) {
    std::vector<int64_t> count(F, 0), bounds(threads + 1, F);
    for (int64_t i = 0; i < N; ++i) ++count[face[i]];
    bounds[0] = 0;
    int64_t sum = 0;
    int next = 1;
    for (int64_t f = 0; f < F && next < threads; ++f) {
        sum += count[f];
        while (next < threads && sum >= share(N, next, threads)) bounds[next++] = f + 1;
    }
    return bounds;
}

// Calls work(i, thread) for every Gaussian. With `by_face`, those of one face are taken by one thread, in index order.
template <class Work>
void for_gaussians(const int64_t* face, int64_t N, int64_t F, bool by_face, int threads, Work&& work) {
    const std::vector<int64_t> bounds = by_face && threads > 1 ? face_bounds(face, N, F, threads) : std::vector<int64_t>();
    run_threads(threads, [&](int t) {
        if (bounds.empty()) {
            for (int64_t i = share(N, t, threads), end = share(N, t + 1, threads); i < end; ++i) work(i, t);
            return;
        }
        for (int64_t i = 0; i < N; ++i)
            if (face[i] >= bounds[t] && face[i] < bounds[t + 1]) work(i, t);
    });
}

}  // namespace smplxpp::binding
