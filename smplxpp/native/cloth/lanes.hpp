// Four places side by side, a coordinate a register, and constraints in batches of four that may be solved so.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "cloth/vec3.hpp"

namespace smplxpp {

constexpr int kLanes = 4;
using Mask4 = int32_t __attribute__((vector_size(16)));  // of a comparison: -1 in the lanes where it holds, else 0
using Lanes = std::array<int32_t, kLanes>;

// The coordinates of four places, or of four differences between them.
struct Soa {
    Vec4 x, y, z;
    friend Soa operator+(Soa a, Soa b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    friend Soa operator-(Soa a, Soa b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
    friend Soa operator*(Soa a, Vec4 s) { return {a.x * s, a.y * s, a.z * s}; }
};

inline Vec4 dot(Soa a, Soa b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Soa cross(Soa a, Soa b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline Vec4 root(Vec4 a) { return Vec4{std::sqrt(a[0]), std::sqrt(a[1]), std::sqrt(a[2]), std::sqrt(a[3])}; }
inline Vec4 length(Soa a) { return root(dot(a, a)); }
inline Vec4 all_lanes(float value) { return Vec4{value, value, value, value}; }

inline Soa broadcast(Vec3 a) { return {all_lanes(a.x), all_lanes(a.y), all_lanes(a.z)}; }

inline bool any(Mask4 mask) {
#if defined(__wasm_simd128__)
    return __builtin_wasm_any_true_v128((signed char __attribute__((vector_size(16))))mask);
#elif defined(__SSE__)
    return __builtin_ia32_movmskps((Vec4)mask) != 0;
#else
    const auto halves = (int64_t __attribute__((vector_size(16))))mask;
    return (halves[0] | halves[1]) != 0;
#endif
}
inline Vec4 select(Mask4 mask, Vec4 yes, Vec4 no) { return (Vec4)((mask & (Mask4)yes) | (~mask & (Mask4)no)); }

// Rows of places to columns of coordinates, and back, by pairs: what processors have instructions for.
inline Vec4 lower(Vec4 a, Vec4 b) { return Vec4{a[0], b[0], a[1], b[1]}; }
inline Vec4 upper(Vec4 a, Vec4 b) { return Vec4{a[2], b[2], a[3], b[3]}; }
inline Vec4 first_halves(Vec4 a, Vec4 b) { return Vec4{a[0], a[1], b[0], b[1]}; }
inline Vec4 second_halves(Vec4 a, Vec4 b) { return Vec4{a[2], a[3], b[2], b[3]}; }
inline Soa columns(Vec4 a, Vec4 b, Vec4 c, Vec4 d) {
    const Vec4 ab = lower(a, b), cd = lower(c, d);
    return {first_halves(ab, cd), second_halves(ab, cd), first_halves(upper(a, b), upper(c, d))};
}
inline void rows(Soa a, Vec4* out) {
    const Vec4 zero = all_lanes(0);
    const Vec4 xy = lower(a.x, a.y), z = lower(a.z, zero), xy_on = upper(a.x, a.y), z_on = upper(a.z, zero);
    out[0] = first_halves(xy, z), out[1] = second_halves(xy, z);
    out[2] = first_halves(xy_on, z_on), out[3] = second_halves(xy_on, z_on);
}

// The points of four triangles that are nearest to p, and their barycentric weights (Ericson 2004, chapter 5.1.5): near a
// corner, an edge, or within; of the cases that hold the first counts.
inline Soa closest_on_triangles(Soa p, Soa a, Soa b, Soa c, Vec4* weight) {
    const Vec4 zero = all_lanes(0), one = all_lanes(1);
    const Soa ab = b - a, ac = c - a, ap = p - a, bp = p - b, cp = p - c;
    const Vec4 d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
    const Vec4 vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4, to_c = d4 - d3, to_b = d5 - d6;
    const Mask4 at_a = (d1 <= 0) & (d2 <= 0), at_b = (d3 >= 0) & (d4 <= d3), at_c = (d6 >= 0) & (d5 <= d6);
    const Mask4 on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0), on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0);
    const Mask4 on_bc = (va <= 0) & (to_c >= 0) & (to_b >= 0), on_edge = on_ab | on_ac | on_bc;
    // A place on an edge divides it, one within the triangle has the areas across from b and c: a division for all.
    const Vec4 part = select(on_ab, d1, select(on_ac, d2, to_c));
    const Vec4 whole = select(on_ab, d1 - d3, select(on_ac, d2 - d6, to_c + to_b));
    const Vec4 share = select(on_edge, part, one) / select(on_edge, whole, va + vb + vc), rest = one - share;
    const Vec4 v = select(on_edge, select(on_ab, share, select(on_ac, zero, rest)), vb * share);
    const Vec4 w = select(on_edge, select(on_ab, zero, share), vc * share);
    const Vec4 u = select(on_edge, select(on_ab | on_ac, rest, zero), one - v - w);
    weight[0] = select(at_a, one, select(at_b, zero, select(on_ab, u, select(at_c, zero, u))));
    weight[1] = select(at_a, zero, select(at_b, one, select(on_ab, v, select(at_c, zero, v))));
    weight[2] = select(at_a | at_b, zero, select(on_ab, w, select(at_c, one, w)));
    return a * weight[0] + b * weight[1] + c * weight[2];
}

// Constraints of Corners particles each in batches of four that share none; -1 in lanes that stay empty. Each constraint comes
// in a later batch than all before it in the array that share a particle with it. Since it reads and writes its own particles
// alone, batch after batch gives the bits that the array's order gives, and the batches backwards those of the array backwards.
template <int Corners>
std::vector<Lanes> in_batches(const int32_t* corner, int64_t count, int64_t particles) {
    std::vector<Lanes> batches;
    std::vector<int32_t> earliest(size_t(particles), 0);  // of a particle: the batch after its last one
    std::vector<int32_t> filled, next;  // of a batch: how many lanes; itself, or one behind it that may have room
    const auto with_room = [&](int32_t at) {
        while (at < int32_t(next.size()) && next[size_t(at)] != at) {
            const int32_t further = next[size_t(at)];
            if (further < int32_t(next.size())) next[size_t(at)] = next[size_t(further)];
            at = further;
        }
        return size_t(at);
    };
    for (int64_t k = 0; k < count; ++k) {
        int32_t first = 0;
        for (int j = 0; j < Corners; ++j) first = std::max(first, earliest[size_t(corner[Corners * k + j])]);
        const size_t at = with_room(first);
        if (at == batches.size()) {
            batches.push_back({-1, -1, -1, -1});
            filled.push_back(0), next.push_back(int32_t(at));
        }
        batches[at][size_t(filled[at])] = int32_t(k);
        if (++filled[at] == kLanes) next[at] = int32_t(at) + 1;
        for (int j = 0; j < Corners; ++j) earliest[size_t(corner[Corners * k + j])] = int32_t(at) + 1;
    }
    return batches;
}

// Which batches wait, in order; forwards or backwards, with those that come to wait ahead of where a walk is.
class Waiting {
public:
    void all(size_t count) {
        bits_.assign((count + 63) / 64, ~uint64_t(0));
        if (count % 64) bits_.back() >>= 64 - count % 64;
    }
    void add(int32_t batch) { bits_[size_t(batch) / 64] |= uint64_t(1) << (batch % 64); }
    template <class Visit>
    void walk(bool back, Visit&& visit) {
        const size_t words = bits_.size();
        for (size_t k = 0; k < words; ++k) {
            const size_t word = back ? words - 1 - k : k;
            uint64_t left = ~uint64_t(0);  // bits that the walk has not passed
            while (const uint64_t here = bits_[word] & left) {
                const int bit = back ? 63 - __builtin_clzll(here) : __builtin_ctzll(here);
                left = back ? (uint64_t(1) << bit) - 1 : ~uint64_t(0) << bit << 1;
                bits_[word] &= ~(uint64_t(1) << bit);
                visit(int32_t(64 * word) + bit);
            }
        }
    }

private:
    std::vector<uint64_t> bits_;
};

}  // namespace smplxpp
