// Vectors of three floats.
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

}  // namespace smplxpp
