// The frame of a triangle, in which its Gaussians hang (avatar/gaussians/frames.py is the truth), and rotations as quaternions.
#pragma once
#include <algorithm>
#include <cfloat>
#include <cmath>

#include "gaussians/binding_math.hpp"

namespace smplxpp::binding {

constexpr float kMinEdge = 1e-6f;
constexpr float kTolerance = 100.0f * FLT_EPSILON;

struct Frame {
    Vec a, b, c;            // sides from the first corner, and from the second to the third
    Vec n, q;               // columns of the rotation
    float cross_norm, median_norm, mean_edge;
    bool degenerate;
};

inline Frame make_frame(Vec v1, Vec v2, Vec v3) {
    Frame f;
    f.a = v2 - v1, f.b = v3 - v1, f.c = v3 - v2;
    Vec across = cross(f.a, f.b), along = 0.5f * (f.a + f.b);
    f.mean_edge = (length(f.a) + length(f.b) + length(f.c)) / 3.0f;
    const float edge = std::max(f.mean_edge, kMinEdge);
    // `!(>)`: the smallest cross products round to 0.
    f.degenerate = !(length(across) > kTolerance * edge * edge);
    if (f.degenerate) {
        if (!(length(along) > kTolerance * f.mean_edge)) along = f.a;
        if (!(length(along) > kTolerance * kMinEdge)) along = {1, 0, 0};
        const float x = std::fabs(along.x), y = std::fabs(along.y), z = std::fabs(along.z);
        const Vec axis = x <= y && x <= z ? Vec{1, 0, 0} : y <= z ? Vec{0, 1, 0} : Vec{0, 0, 1};
        // Scaled first: squares of the shortest sides underflow.
        along = (1.0f / std::max(x, std::max(y, z))) * along;
        across = cross(along, axis);
    }
    f.cross_norm = length(across), f.median_norm = length(along);
    f.n = (1.0f / f.cross_norm) * across, f.q = (1.0f / f.median_norm) * along;
    return f;
}

// 4 q q^T as the ten numbers (ww xx yy zz wx wy wz xy xz yz), linear in the rotation.
constexpr int kOuter[4][4] = {{0, 4, 5, 6}, {4, 1, 7, 8}, {5, 7, 2, 9}, {6, 8, 9, 3}};

inline int best_row(const float* m, float row[4]) {
    const float d[10] = {1 + m[0] + m[4] + m[8], 1 + m[0] - m[4] - m[8], 1 - m[0] + m[4] - m[8], 1 - m[0] - m[4] + m[8],
                         m[7] - m[5], m[2] - m[6], m[3] - m[1], m[1] + m[3], m[2] + m[6], m[5] + m[7]};
    const int best = int(std::max_element(d, d + 4) - d);
    for (int k = 0; k < 4; ++k) row[k] = d[kOuter[best][k]];
    return best;
}

inline void quat_of(const float* m, float q[4]) {
    best_row(m, q);
    const float scale = 1.0f / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 4; ++k) q[k] *= scale;
}

}  // namespace smplxpp::binding
