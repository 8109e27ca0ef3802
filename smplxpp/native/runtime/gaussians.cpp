// Gaussians of a player: what blend shapes add to them, and from their triangles' frames to the world. They lie in the order
// of their triangles, so that a frame is made once and used at once.
#include <algorithm>
#include <vector>

#include "common/parallel.hpp"
#include "common/simd.hpp"
#include "common/status.hpp"
#include "gaussians/triangle_frame.hpp"

namespace {

using namespace smplxpp;
using binding::Vec;

constexpr int NUMBERS = 6;  // position and colour

// Blend shapes of one side, head or body; mirrored by avatar/runtime/kernels.py.
struct Shapes {
    int64_t rows, shapes, count, parts;
    const int8_t* steps;      // (blocks of 16 rows, shapes, 6, 16) in steps, or null
    const float* values;      // the same as numbers, or null
    const float* scale;       // (rows, padded to blocks): a unit of a row's steps
    const int32_t* row;       // (rows) the Gaussian, or null where they are all
    const int32_t* part;      // (rows) below `parts`, or null where there is one
};

SMPLXPP_INLINE Floats lanes_of(const float* p) { return load(p); }
SMPLXPP_INLINE Floats lanes_of(const int8_t* p) {
    alignas(64) float wide[LANES];
    for (int l = 0; l < LANES; ++l) wide[l] = (float)p[l];
    return load(wide);
}

// z (parts, shapes, 6): coefficients times steps.
template <class Number>
void add_shapes(const Shapes& in, const Number* values, const float* z, const float* keep, float* added, int64_t b) {
    const int64_t first = b * LANES, count = std::min<int64_t>(LANES, in.rows - first), n = in.shapes;
    Floats sum[NUMBERS] = {};
    const Number* own = values + first * n * NUMBERS;
    if (in.part) {
        alignas(64) float wide[LANES];
        for (int64_t k = 0; k < n; ++k)
            for (int c = 0; c < NUMBERS; ++c) {
                for (int l = 0; l < LANES; ++l) wide[l] = z[(in.part[first + std::min<int64_t>(l, count - 1)] * n + k) * NUMBERS + c];
                sum[c] = fma(load(wide), lanes_of(own + (k * NUMBERS + c) * LANES), sum[c]);
            }
    } else {
        for (int64_t k = 0; k < n; ++k)
            for (int c = 0; c < NUMBERS; ++c)
                sum[c] = fma(broadcast(z[k * NUMBERS + c]), lanes_of(own + (k * NUMBERS + c) * LANES), sum[c]);
    }
    const Floats scale = load(in.scale + first);
    alignas(64) float out[NUMBERS][LANES];
    for (int c = 0; c < NUMBERS; ++c) store(out[c], sum[c] * scale);
    for (int64_t l = 0; l < count; ++l) {
        const int64_t i = in.row ? in.row[first + l] : first + l;
        const float share = keep ? keep[i] : 1.0f;
        for (int c = 0; c < NUMBERS; ++c) added[NUMBERS * i + c] += share * out[c][l];
    }
}

// Mirrored by avatar/runtime/kernels.py. first (F + 1): a triangle's first Gaussian.
struct Bound {
    int64_t faces, count, vertices;
    const int32_t *face, *first;                                    // (F, 3) (F + 1)
    const float *barycentric, *offset, *scales, *quats, *dc;        // (N, 2) (N, 3) (N, 2) (N, 4) (N, 3)
    float thickness;
    int32_t reserved;
};

}  // namespace

// Adds U z to positions and C z to colours: added (N, 6). keep (N), or null: what part of it a Gaussian takes.
SMPLXPP_EXPORT int32_t smplxpp_runtime_blend(const Shapes* in, const float* z, const float* keep, float* added, int32_t threads) {
    return guarded([&] {
        if (in->row) check_indices(in->row, in->rows, in->count);
        else if (in->rows > in->count) throw_out_of_range("rows");
        if (in->part) check_indices(in->part, in->rows, in->parts);
        const int64_t blocks = (in->rows + LANES - 1) / LANES;
        run_threads(threads, [&](int t) {
            for (int64_t b = blocks * t / threads, end = blocks * (t + 1) / threads; b < end; ++b) {
                if (in->steps) add_shapes(*in, in->steps, z, keep, added, b);
                else add_shapes(*in, in->values, z, keep, added, b);
            }
        });
    });
}

// posed (V, 3); added (N, 6) or null. Writes means (N, 3), quats (N, 4), scales (N, 3), dc (N, 3) and the rotations of the
// triangles' frames (F, 3, 3).
SMPLXPP_EXPORT int32_t smplxpp_runtime_world(const Bound* in, const float* posed, const float* added, float* means, float* quats,
                                             float* scales, float* dc, float* rotations, int32_t threads) {
    return guarded([&] {
        check_indices(in->face, 3 * in->faces, in->vertices);
        if (in->first[0] != 0 || in->first[in->faces] != in->count) throw_out_of_range("first");
        run_threads(threads, [&](int t) {
            for (int64_t f = in->faces * t / threads, end = in->faces * (t + 1) / threads; f < end; ++f) {
                const int32_t* face = in->face + 3 * f;
                const Vec v1 = binding::load(posed + 3 * (int64_t)face[0]), v2 = binding::load(posed + 3 * (int64_t)face[1]),
                          v3 = binding::load(posed + 3 * (int64_t)face[2]);
                const binding::Frame frame = binding::make_frame(v1, v2, v3);
                const Vec p = binding::cross(frame.n, frame.q);
                const float R[9] = {frame.n.x, frame.q.x, p.x, frame.n.y, frame.q.y, p.y, frame.n.z, frame.q.z, p.z};
                std::copy(R, R + 9, rotations + 9 * f);
                float q[4];
                binding::quat_of(R, q);
                const float edge = std::max(frame.mean_edge, binding::kMinEdge);
                for (int64_t i = in->first[f]; i < in->first[f + 1]; ++i) {
                    const float u = in->barycentric[2 * i], v = in->barycentric[2 * i + 1];
                    Vec local = binding::load(in->offset + 3 * i), color = binding::load(in->dc + 3 * i);
                    if (added) {
                        local = local + binding::load(added + NUMBERS * i);
                        color = color + binding::load(added + NUMBERS * i + 3);
                    }
                    binding::store(means + 3 * i, u * v1 + v * v2 + (1 - u - v) * v3 + binding::turn(R, local));
                    binding::store(dc + 3 * i, color);
                    binding::store(scales + 3 * i, edge * Vec{in->thickness, in->scales[2 * i], in->scales[2 * i + 1]});
                    const float* r = in->quats + 4 * i;
                    float* out = quats + 4 * i;
                    out[0] = q[0] * r[0] - q[1] * r[1] - q[2] * r[2] - q[3] * r[3];
                    out[1] = q[0] * r[1] + q[1] * r[0] + q[2] * r[3] - q[3] * r[2];
                    out[2] = q[0] * r[2] - q[1] * r[3] + q[2] * r[0] + q[3] * r[1];
                    out[3] = q[0] * r[3] + q[1] * r[2] - q[2] * r[1] + q[3] * r[0];
                }
            }
        });
    });
}
