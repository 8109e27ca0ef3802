// Vectors of three floats, and the nearest point of a triangle.
#pragma once
#include <cmath>

namespace smplxpp {

struct Vec3 {
    float x, y, z;
    friend Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    friend Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
    friend Vec3 operator*(Vec3 a, float s) { return {a.x * s, a.y * s, a.z * s}; }
};

inline float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline float length(Vec3 a) { return std::sqrt(dot(a, a)); }

// The same in a register of four floats, of which the last means nothing: what is stored whole is loaded again at once.
using Vec4 = float __attribute__((vector_size(16)));

inline Vec4 widened(Vec3 a) { return Vec4{a.x, a.y, a.z, 0}; }
inline Vec3 narrowed(Vec4 a) { return {a[0], a[1], a[2]}; }
inline float dot(Vec4 a, Vec4 b) {
    const Vec4 products = a * b;
    return products[0] + products[1] + products[2];
}
inline Vec4 cross(Vec4 a, Vec4 b) {
    return Vec4{a[1], a[2], a[0], 0} * Vec4{b[2], b[0], b[1], 0} - Vec4{a[2], a[0], a[1], 0} * Vec4{b[1], b[2], b[0], 0};
}
inline float length(Vec4 a) { return std::sqrt(dot(a, a)); }

// The point of a triangle that is nearest to p, and its barycentric weights (Ericson 2004, chapter 5.1.5).
inline Vec3 closest_on_triangle(Vec3 p, Vec3 a, Vec3 b, Vec3 c, float* weight) {
    const auto at = [&](float u, float v, float w) {
        weight[0] = u, weight[1] = v, weight[2] = w;
        return a * u + b * v + c * w;
    };
    const Vec3 ab = b - a, ac = c - a, ap = p - a, bp = p - b, cp = p - c;
    const float d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
    if (d1 <= 0 && d2 <= 0) return at(1, 0, 0);
    if (d3 >= 0 && d4 <= d3) return at(0, 1, 0);
    const float vc = d1 * d4 - d3 * d2;
    if (vc <= 0 && d1 >= 0 && d3 <= 0) return at(1 - d1 / (d1 - d3), d1 / (d1 - d3), 0);
    if (d6 >= 0 && d5 <= d6) return at(0, 0, 1);
    const float vb = d5 * d2 - d1 * d6;
    if (vb <= 0 && d2 >= 0 && d6 <= 0) return at(1 - d2 / (d2 - d6), 0, d2 / (d2 - d6));
    const float va = d3 * d6 - d5 * d4;
    if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
        const float w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return at(0, 1 - w, w);
    }
    const float over = 1.0f / (va + vb + vc), v = vb * over, w = vc * over;
    return at(1 - v - w, v, w);
}

}  // namespace smplxpp
