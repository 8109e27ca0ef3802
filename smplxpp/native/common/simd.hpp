// Sixteen floats at a time on any CPU: the register width is the compiler's (one 64-byte vector with AVX-512, two of 32
// bytes with AVX, four of 16 bytes with SSE2 or NEON), the source is one. Built on the vector extensions of GCC and Clang;
// intrinsics only where those have no word for what the hardware does (mask registers, reciprocal estimate, movemask).
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // GCC 12 warns of its own _mm512_undefined_ps (its bug 105593)
#include <immintrin.h>
#pragma GCC diagnostic pop
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define SMPLXPP_INLINE inline __attribute__((always_inline))

namespace smplxpp {

constexpr int LANES = 16;

#if defined(__AVX512F__)
constexpr int NATIVE = 16;
#elif defined(__AVX__)
constexpr int NATIVE = 8;
#else
constexpr int NATIVE = 4;
#endif
typedef float NativeFloat __attribute__((vector_size(4 * NATIVE)));
typedef int32_t NativeInt __attribute__((vector_size(4 * NATIVE)));
typedef uint32_t NativeUnsigned __attribute__((vector_size(4 * NATIVE)));

// A binary tree of native vectors: unlike an array it is taken apart into registers before loops are unrolled.
template <class Native, int Parts>
struct Tree {
    Tree<Native, Parts / 2> lo, hi;
};
template <class Native>
struct Tree<Native, 1> {
    Native v;
};
constexpr int PARTS = LANES / NATIVE;
using Floats = Tree<NativeFloat, PARTS>;
using Ints = Tree<NativeInt, PARTS>;

template <int P, class Op, class... N>
SMPLXPP_INLINE auto map(Op op, const Tree<N, P>&... x) {
    if constexpr (P == 1) {
        return Tree<decltype(op(x.v...)), 1>{op(x.v...)};
    } else {
        auto lo = map<P / 2>(op, x.lo...);
        auto hi = map<P / 2>(op, x.hi...);
        return Tree<decltype(op(N{}...)), P>{lo, hi};
    }
}

SMPLXPP_INLINE Floats operator+(Floats a, Floats b) { return map<PARTS>([](auto x, auto y) { return x + y; }, a, b); }
SMPLXPP_INLINE Floats operator-(Floats a, Floats b) { return map<PARTS>([](auto x, auto y) { return x - y; }, a, b); }
SMPLXPP_INLINE Floats operator*(Floats a, Floats b) { return map<PARTS>([](auto x, auto y) { return x * y; }, a, b); }

// a * b + c and c - a * b; one rounding where the hardware has it (contraction is on for the kernels).
SMPLXPP_INLINE Floats fma(Floats a, Floats b, Floats c) {
    return map<PARTS>([](auto x, auto y, auto z) { return x * y + z; }, a, b, c);
}
SMPLXPP_INLINE Floats fnma(Floats a, Floats b, Floats c) {
    return map<PARTS>([](auto x, auto y, auto z) { return z - x * y; }, a, b, c);
}
// NaN in a gives b.
SMPLXPP_INLINE Floats min(Floats a, Floats b) {
    return map<PARTS>([](auto x, auto y) -> NativeFloat { return x < y ? x : y; }, a, b);
}
SMPLXPP_INLINE Floats max(Floats a, Floats b) {
    return map<PARTS>([](auto x, auto y) -> NativeFloat { return x > y ? x : y; }, a, b);
}

template <class T, class Element, int P>
SMPLXPP_INLINE Tree<T, P> broadcast_tree(Element x) {
    if constexpr (P == 1) {
        return {x - T{}};
    } else {
        return {broadcast_tree<T, Element, P / 2>(x), broadcast_tree<T, Element, P / 2>(x)};
    }
}
SMPLXPP_INLINE Floats broadcast(float x) { return broadcast_tree<NativeFloat, float, PARTS>(x); }
SMPLXPP_INLINE Ints broadcast(int32_t x) { return broadcast_tree<NativeInt, int32_t, PARTS>(x); }
SMPLXPP_INLINE Floats zeros() { return Floats{}; }

// Memory is read and written register by register: a copy of a whole tree would be made in smaller pieces on the stack,
// which a wider load cannot take up before they have left the store buffer.
template <class Native, class Element, int P>
SMPLXPP_INLINE Tree<Native, P> load_tree(const Element* p) {
    typedef Native Unaligned __attribute__((aligned(4), may_alias));
    if constexpr (P == 1) {
        return {*(const Unaligned*)p};
    } else {
        return {load_tree<Native, Element, P / 2>(p), load_tree<Native, Element, P / 2>(p + P / 2 * NATIVE)};
    }
}
template <class Native, class Element, int P>
SMPLXPP_INLINE void store_tree(Element* p, const Tree<Native, P>& a) {
    typedef Native Unaligned __attribute__((aligned(4), may_alias));
    if constexpr (P == 1) {
        *(Unaligned*)p = a.v;
    } else {
        store_tree<Native, Element, P / 2>(p, a.lo);
        store_tree<Native, Element, P / 2>(p + P / 2 * NATIVE, a.hi);
    }
}
SMPLXPP_INLINE Floats load(const float* p) { return load_tree<NativeFloat, float, PARTS>(p); }
SMPLXPP_INLINE Ints load(const int32_t* p) { return load_tree<NativeInt, int32_t, PARTS>(p); }
SMPLXPP_INLINE void store(float* p, Floats a) { store_tree<NativeFloat, float, PARTS>(p, a); }
SMPLXPP_INLINE void store(int32_t* p, Ints a) { store_tree<NativeInt, int32_t, PARTS>(p, a); }

SMPLXPP_INLINE Ints shifted_right(Ints a, int bits) {
    return map<PARTS>([bits](auto x) { return x >> bits; }, a);
}
SMPLXPP_INLINE Ints truncated(Floats a) {
    return map<PARTS>([](auto x) { return __builtin_convertvector(x, NativeInt); }, a);
}

// Masks: a bit a lane in a mask register with AVX-512, else all bits of the lane.
#if defined(__AVX512F__)
struct Mask {
    __mmask16 bits;
};
SMPLXPP_INLINE Mask operator>=(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
SMPLXPP_INLINE Mask operator>(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
SMPLXPP_INLINE Mask operator<(Floats a, Floats b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
SMPLXPP_INLINE Mask operator>(Ints a, Ints b) { return {_mm512_cmpgt_epi32_mask((__m512i)a.v, (__m512i)b.v)}; }
SMPLXPP_INLINE Mask operator&(Mask a, Mask b) { return {(__mmask16)(a.bits & b.bits)}; }
SMPLXPP_INLINE Mask without(Mask a, Mask b) { return {(__mmask16)(a.bits & ~b.bits)}; }
SMPLXPP_INLINE bool any(Mask a) { return a.bits != 0; }
SMPLXPP_INLINE Floats where(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m.bits, a.v)}; }
SMPLXPP_INLINE Floats where(Mask m, Floats a, Floats b) { return {_mm512_mask_blend_ps(m.bits, b.v, a.v)}; }
SMPLXPP_INLINE Ints where(Mask m, Ints a, Ints b) {
    return {(NativeInt)_mm512_mask_blend_epi32(m.bits, (__m512i)b.v, (__m512i)a.v)};
}
#else
using Mask = Ints;
SMPLXPP_INLINE Mask operator>=(Floats a, Floats b) { return map<PARTS>([](auto x, auto y) -> NativeInt { return x >= y; }, a, b); }
SMPLXPP_INLINE Mask operator>(Floats a, Floats b) { return map<PARTS>([](auto x, auto y) -> NativeInt { return x > y; }, a, b); }
SMPLXPP_INLINE Mask operator<(Floats a, Floats b) { return map<PARTS>([](auto x, auto y) -> NativeInt { return x < y; }, a, b); }
SMPLXPP_INLINE Mask operator>(Ints a, Ints b) { return map<PARTS>([](auto x, auto y) -> NativeInt { return x > y; }, a, b); }
SMPLXPP_INLINE Mask operator&(Mask a, Mask b) { return map<PARTS>([](auto x, auto y) { return x & y; }, a, b); }
SMPLXPP_INLINE Mask without(Mask a, Mask b) { return map<PARTS>([](auto x, auto y) { return x & ~y; }, a, b); }
SMPLXPP_INLINE Floats where(Mask m, Floats a) {
    return map<PARTS>([](auto k, auto x) { return (NativeFloat)(k & (NativeInt)x); }, m, a);
}
SMPLXPP_INLINE Floats where(Mask m, Floats a, Floats b) {
    return map<PARTS>([](auto k, auto x, auto y) -> NativeFloat { return k ? x : y; }, m, a, b);
}
SMPLXPP_INLINE Ints where(Mask m, Ints a, Ints b) {
    return map<PARTS>([](auto k, auto x, auto y) -> NativeInt { return k ? x : y; }, m, a, b);
}
SMPLXPP_INLINE bool any_native(NativeInt x) {
#if defined(__AVX__)
    return _mm256_movemask_ps((__m256)x) != 0;
#elif defined(__SSE2__)
    return _mm_movemask_ps((__m128)x) != 0;
#elif defined(__aarch64__)
    return vmaxvq_u32((uint32x4_t)x) != 0;
#else
    return (x[0] | x[1] | x[2] | x[3]) != 0;
#endif
}
template <int P>
SMPLXPP_INLINE NativeInt folded(const Tree<NativeInt, P>& x) {
    if constexpr (P == 1) {
        return x.v;
    } else {
        return folded(x.lo) | folded(x.hi);
    }
}
SMPLXPP_INLINE bool any(Mask a) { return any_native(folded(a)); }
#endif

// 1 / x to the last bit or two. One step of Newton's method from AVX-512's estimate of 14 bits gives that; from the 12 bits
// of older ones it would fall short by 1e-7 each time, always to one side, so a division is made there.
SMPLXPP_INLINE Floats reciprocal(Floats a) {
#if defined(__AVX512F__)
    NativeFloat r = _mm512_rcp14_ps(a.v);
    return {r * (2.0f - a.v * r)};
#else
    return map<PARTS>([](auto x) { return 1.0f / x; }, a);
#endif
}

SMPLXPP_INLINE Floats square_root(Floats a) {
    return map<PARTS>([](auto x) {
#if defined(__AVX512F__)
        return (NativeFloat)_mm512_sqrt_ps(x);
#elif defined(__AVX__)
        return (NativeFloat)_mm256_sqrt_ps(x);
#elif defined(__SSE2__)
        return (NativeFloat)_mm_sqrt_ps(x);
#elif defined(__aarch64__)
        return (NativeFloat)vsqrtq_f32(x);
#else
        for (int i = 0; i < NATIVE; ++i) x[i] = __builtin_sqrtf(x[i]);
        return x;
#endif
    }, a);
}

// 2^x for -126 < x < 126 with a relative error of 9e-8; anything at all elsewhere, which callers mask away.
// x is split into its nearest integer n (adding 1.5 * 2^23 leaves n in the low bits) and the rest, for which a minimax
// polynomial of degree 5 stands, in Estrin's order: what waits for it waits less. n is added to the exponent (unsigned:
// far outside of the range it wraps).
SMPLXPP_INLINE Floats exp2(Floats a) {
    return map<PARTS>([](auto x) {
        const float shift = 12582912.0f;
        NativeFloat shifted = x + shift, f = x - (shifted - shift), f2 = f * f;
        NativeFloat low = 0.69314694f * f + 1.0f, middle = 0.055507287f * f + 0.24022213f;
        NativeFloat high = 0.0013264814f * f + 0.0096716740f;
        NativeFloat r = (high * f2 + middle) * f2 + low;
        return (NativeFloat)((NativeUnsigned)r + ((NativeUnsigned)shifted << 23));
    }, a);
}

// out[i] += the sum of the lanes of a[i], for i = 0 .. 15: a transposition and the sums in one.
#if defined(__AVX512F__)
SMPLXPP_INLINE void add_lane_sums(const Floats* a, float* out) {
    __m512 y[8], z[4];
    for (int i = 0; i < 8; ++i) {  // the halves of rows i and i + 8
        y[i] = _mm512_shuffle_f32x4(a[i].v, a[i + 8].v, 0x44) + _mm512_shuffle_f32x4(a[i].v, a[i + 8].v, 0xEE);
    }
    for (int i = 0; i < 4; ++i) {  // quarters hold rows i, i + 8, i + 4, i + 12
        z[i] = _mm512_shuffle_f32x4(y[i], y[i + 4], 0x88) + _mm512_shuffle_f32x4(y[i], y[i + 4], 0xDD);
    }
    __m512 p = _mm512_unpacklo_ps(z[0], z[1]) + _mm512_unpackhi_ps(z[0], z[1]);
    __m512 q = _mm512_unpacklo_ps(z[2], z[3]) + _mm512_unpackhi_ps(z[2], z[3]);
    __m512 s = _mm512_shuffle_ps(p, q, 0x44) + _mm512_shuffle_ps(p, q, 0xEE);
    s = _mm512_shuffle_f32x4(s, s, 0xD8);
    _mm512_storeu_ps(out, _mm512_loadu_ps(out) + s);
}
#else
typedef float Quad __attribute__((vector_size(16)));
typedef int32_t QuadIndex __attribute__((vector_size(16)));
SMPLXPP_INLINE Quad quad_shuffle(Quad a, Quad b, QuadIndex i) {
#if defined(__clang__)
    Quad r;
    for (int k = 0; k < 4; ++k) r[k] = i[k] < 4 ? a[i[k]] : b[i[k] - 4];
    return r;
#else
    return __builtin_shuffle(a, b, i);
#endif
}
SMPLXPP_INLINE Quad quad_sum(const Floats& a) {
#if defined(__AVX__)
    NativeFloat s = a.lo.v + a.hi.v;
    return (Quad)_mm256_castps256_ps128(s) + (Quad)_mm256_extractf128_ps(s, 1);
#else
    return (a.lo.lo.v + a.lo.hi.v) + (a.hi.lo.v + a.hi.hi.v);
#endif
}
SMPLXPP_INLINE void add_lane_sums(const Floats* a, float* out) {
    for (int k = 0; k < LANES; k += 4) {
        Quad x0 = quad_sum(a[k]), x1 = quad_sum(a[k + 1]), x2 = quad_sum(a[k + 2]), x3 = quad_sum(a[k + 3]);
        const QuadIndex low = {0, 4, 1, 5}, high = {2, 6, 3, 7};
        Quad p = quad_shuffle(x0, x1, low) + quad_shuffle(x0, x1, high);
        Quad q = quad_shuffle(x2, x3, low) + quad_shuffle(x2, x3, high);
        Quad s = quad_shuffle(p, q, QuadIndex{0, 1, 4, 5}) + quad_shuffle(p, q, QuadIndex{2, 3, 6, 7}), o;
        std::memcpy(&o, out + k, sizeof o);
        o += s;
        std::memcpy(out + k, &o, sizeof o);
    }
}
#endif

}  // namespace smplxpp
