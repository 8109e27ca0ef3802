// Gaussians bound to triangles: frames of the triangles, Gaussians from their frames to the world, colours by spherical
// harmonics in the frames, and the gradients of all three. The equations are those of avatar/gaussians, whose torch
// versions are the truth; a matrix is row-major, a quaternion wxyz, every array float32.
//
// Gradients of many Gaussians meet in one face: a thread owns a range of faces and takes their Gaussians in index order, so
// the sums are the same bits for any number of threads.
#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstdint>
#include <vector>

#include "gaussians/binding_math.hpp"
#include "gaussians/harmonics.hpp"
#include "gaussians/triangle_frame.hpp"
#include "common/parallel.hpp"

namespace {

using namespace smplxpp::binding;
using smplxpp::guarded;
using smplxpp::run_threads;

// Adds to gm the gradient to the matrix, from g to its quaternion.
void quat_gradient(const float* m, const float* g, float* gm) {
    float row[4];
    const int best = best_row(m, row);
    const float square = row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3];
    const float scale = 1.0f / std::sqrt(square);
    const float along = (row[0] * g[0] + row[1] * g[1] + row[2] * g[2] + row[3] * g[3]) / square;
    float d[10] = {};
    for (int k = 0; k < 4; ++k) d[kOuter[best][k]] += scale * (g[k] - along * row[k]);
    gm[0] += d[0] + d[1] - d[2] - d[3];
    gm[4] += d[0] - d[1] + d[2] - d[3];
    gm[8] += d[0] - d[1] - d[2] + d[3];
    gm[7] += d[4] + d[9], gm[5] += d[9] - d[4];
    gm[2] += d[5] + d[8], gm[6] += d[8] - d[5];
    gm[3] += d[6] + d[7], gm[1] += d[7] - d[6];
}

// From a camera to a Gaussian, which may sit in it.
float view_distance(Vec v) { return std::max(length(v), 1e-12f); }

template <int K>
void colors_forward(const int64_t* face, const float* rotations, const float* dc, const float* sh, const float* means,
                    const float* cameras, int64_t N, int64_t C, float* colors, int threads) {
    for_gaussians(face, N, 0, false, threads, [&](int64_t i, int) {
        const float* coefficients = sh + 3 * K * i;
        const Vec base = load(dc + 3 * i), mean = load(means + 3 * i);
        for (int64_t c = 0; c < C; ++c) {
            const Vec v = mean - load(cameras + 3 * c);
            float y[K + 1];
            const Vec local = turn_back(rotations + 9 * face[i], (1.0f / view_distance(v)) * v);
            const Vec color = color_before_clamp<K>(local, base, coefficients, y);
            store(colors + 3 * (c * N + i), {std::max(color.x, 0.0f), std::max(color.y, 0.0f), std::max(color.z, 0.0f)});
        }
    });
}

// What a colour's gradient is added to; null where it is not asked for. grad_cameras holds (threads, C, 3).
struct ColorGradients {
    float *dc, *sh, *means, *rotations, *cameras;
};

template <int K>
void colors_backward(const int64_t* face, const float* rotations, const float* dc, const float* sh, const float* means,
                     const float* cameras, const float* g_colors, int64_t N, int64_t F, int64_t C, ColorGradients g, int threads) {
    for_gaussians(face, N, F, g.rotations != nullptr, threads, [&](int64_t i, int thread) {
        const float *R = rotations + 9 * face[i], *coefficients = sh + 3 * K * i;
        const Vec base = load(dc + 3 * i), mean = load(means + 3 * i);
        Vec sum_dc{0, 0, 0}, sum_mean{0, 0, 0};
        float sum_sh[3 * K + 1] = {};
        for (int64_t c = 0; c < C; ++c) {
            const Vec v = mean - load(cameras + 3 * c);
            const float norm = view_distance(v);
            const Vec d = (1.0f / norm) * v, local = turn_back(R, d);
            float y[K + 1], weight[K + 1];
            const Vec color = color_before_clamp<K>(local, base, coefficients, y);
            Vec m = load(g_colors + 3 * (c * N + i));
            // A colour of exactly 0 passes its gradient on, or black could never brighten.
            m = {color.x >= 0 ? m.x : 0, color.y >= 0 ? m.y : 0, color.z >= 0 ? m.z : 0};
            sum_dc = sum_dc + m;
            if constexpr (K > 0) {
                for (int k = 0; k < K; ++k) {
                    add(sum_sh + 3 * k, y[k] * m);
                    weight[k] = dot(m, load(coefficients + 3 * k));
                }
                const Vec g_local = basis_gradient<K>(local, weight);
                const Vec g_v = unit_gradient(turn(R, g_local), d, norm);
                sum_mean = sum_mean + g_v;
                if (g.rotations) add_outer(g.rotations + 9 * face[i], d, g_local);
                if (g.cameras) add(g.cameras + 3 * (thread * C + c), -1.0f * g_v);
            }
        }
        if (g.dc) store(g.dc + 3 * i, sum_dc);
        if (g.sh) std::copy(sum_sh, sum_sh + 3 * K, g.sh + 3 * K * i);
        if (g.means) store(g.means + 3 * i, sum_mean);
    });
}

}  // namespace

// Frames of F triangles of B poses: vertices (B,V,3), faces (F,3) -> corners (B,F,3,3), rotations (B,F,3,3), quats (B,F,4),
// lengths (B,F), and the number of triangles without area.
SMPLXPP_EXPORT int32_t smplxpp_frames_forward(const float* vertices, const int64_t* faces, int64_t B, int64_t V, int64_t F,
                                              float* corners, float* rotations, float* quats, float* lengths,
                                              int64_t* without_area, int threads) { return guarded([&] {
    std::vector<int64_t> degenerate(threads, 0);
    run_threads(threads, [&](int t) {
        for (int64_t i = share(B * F, t, threads), end = share(B * F, t + 1, threads); i < end; ++i) {
            const float* v = vertices + 3 * V * (i / F);
            const int64_t* f = faces + 3 * (i % F);
            const Vec v1 = load(v + 3 * f[0]), v2 = load(v + 3 * f[1]), v3 = load(v + 3 * f[2]);
            const Frame frame = make_frame(v1, v2, v3);
            degenerate[t] += frame.degenerate;
            store(corners + 9 * i, v1), store(corners + 9 * i + 3, v2), store(corners + 9 * i + 6, v3);
            const Vec p = cross(frame.n, frame.q);
            float* R = rotations + 9 * i;
            store(R, {frame.n.x, frame.q.x, p.x});
            store(R + 3, {frame.n.y, frame.q.y, p.y});
            store(R + 6, {frame.n.z, frame.q.z, p.z});
            quat_of(R, quats + 4 * i);
            lengths[i] = std::max(frame.mean_edge, kMinEdge);
        }
    });
    *without_area = 0;
    for (int64_t count : degenerate) *without_area += count;
}); }

// Adds to g_vertices (B,V,3). Gradients that are null are 0.
SMPLXPP_EXPORT int32_t smplxpp_frames_backward(const float* vertices, const int64_t* faces, const float* rotations,
                                            const float* g_corners, const float* g_rotations, const float* g_quats,
                                            const float* g_lengths, int64_t B, int64_t V, int64_t F, float* g_vertices,
                                            int threads) { return guarded([&] {
    std::vector<float> to_corners(9 * B * F);
    run_threads(threads, [&](int t) {
        for (int64_t i = share(B * F, t, threads), end = share(B * F, t + 1, threads); i < end; ++i) {
            const float* v = vertices + 3 * V * (i / F);
            const int64_t* f = faces + 3 * (i % F);
            const Frame frame = make_frame(load(v + 3 * f[0]), load(v + 3 * f[1]), load(v + 3 * f[2]));
            Vec ga{0, 0, 0}, gb{0, 0, 0}, gc{0, 0, 0};
            if (!frame.degenerate && (g_rotations || g_quats)) {
                float gR[9] = {};
                if (g_rotations) std::copy(g_rotations + 9 * i, g_rotations + 9 * i + 9, gR);
                if (g_quats) quat_gradient(rotations + 9 * i, g_quats + 4 * i, gR);
                const Vec gp = column(gR, 2);
                const Vec gn = column(gR, 0) + cross(frame.q, gp), gq = column(gR, 1) + cross(gp, frame.n);
                const Vec g_cross = unit_gradient(gn, frame.n, frame.cross_norm);
                const Vec g_median = unit_gradient(gq, frame.q, frame.median_norm);
                ga = cross(frame.b, g_cross) + 0.5f * g_median, gb = cross(g_cross, frame.a) + 0.5f * g_median;
            }
            if (g_lengths && frame.mean_edge > kMinEdge) {
                const auto side = [&](Vec s) {
                    const float norm = length(s);
                    return (norm > 0 ? g_lengths[i] / (3.0f * norm) : 0.0f) * s;
                };
                ga = ga + side(frame.a), gb = gb + side(frame.b), gc = side(frame.c);
            }
            float* g = to_corners.data() + 9 * i;
            store(g, -1.0f * (ga + gb)), store(g + 3, ga - gc), store(g + 6, gb + gc);
            if (g_corners)
                for (int k = 0; k < 9; ++k) g[k] += g_corners[9 * i + k];
        }
    });
    // One sum after the other: vertices are shared by faces of different threads.
    for (int64_t i = 0; i < B * F; ++i)
        for (int k = 0; k < 3; ++k)
            add(g_vertices + 3 * (V * (i / F) + faces[3 * (i % F) + k]), load(to_corners.data() + 9 * i + 3 * k));
}); }

// The arrays of bound Gaussians and of B poses of the frames, see avatar/gaussians.
struct SmplxppBinding {
    const int64_t* face;                                                     // (N)
    const float *barycentric, *normal_offset, *offset, *log_scales, *quats;  // (N,2) (N) (N,3) (N,2) (N,4)
    const float *corners, *rotations, *frame_quats, *lengths;                // (B,F,3,3) (B,F,3,3) (B,F,4) (B,F)
    int64_t N, F, B;
    float thickness;
};

// means (B,N,3), quats (B,N,4), scales (B,N,3), normals (B,N,3).
SMPLXPP_EXPORT int32_t smplxpp_world_forward(const SmplxppBinding* in, float* means, float* quats, float* scales, float* normals,
                                          int threads) { return guarded([&] {
    for_gaussians(in->face, in->N, in->F, false, threads, [&](int64_t i, int) {
        const float u = in->barycentric[2 * i], v = in->barycentric[2 * i + 1];
        Vec local = load(in->offset + 3 * i);
        local.x += in->normal_offset[i];
        const float s1 = std::exp(in->log_scales[2 * i]), s2 = std::exp(in->log_scales[2 * i + 1]);
        const float* r = in->quats + 4 * i;
        for (int64_t b = 0; b < in->B; ++b) {
            const int64_t f = b * in->F + in->face[i], o = b * in->N + i;
            const float *corner = in->corners + 9 * f, *q = in->frame_quats + 4 * f;
            store(means + 3 * o, u * load(corner) + v * load(corner + 3) + (1 - u - v) * load(corner + 6) +
                                     turn(in->rotations + 9 * f, local));
            store(scales + 3 * o, in->lengths[f] * Vec{in->thickness, s1, s2});
            const float w = q[0] * r[0] - q[1] * r[1] - q[2] * r[2] - q[3] * r[3];
            const float x = q[0] * r[1] + q[1] * r[0] + q[2] * r[3] - q[3] * r[2];
            const float y = q[0] * r[2] - q[1] * r[3] + q[2] * r[0] + q[3] * r[1];
            const float z = q[0] * r[3] + q[1] * r[2] - q[2] * r[1] + q[3] * r[0];
            float* out = quats + 4 * o;
            out[0] = w, out[1] = x, out[2] = y, out[3] = z;
            const Vec axis = {w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)};
            store(normals + 3 * o, (1.0f / (w * w + x * x + y * y + z * z)) * axis);
        }
    });
}); }

// Gradients in (of what the forward pass gives) and out (of what it takes); null: 0, or not asked for. Those of the
// frames are added to.
struct SmplxppBindingGradients {
    const float *means, *quats, *scales, *normals;
    float *barycentric, *normal_offset, *offset, *log_scales, *local_quats;
    float *corners, *rotations, *frame_quats, *lengths;
};

SMPLXPP_EXPORT int32_t smplxpp_world_backward(const SmplxppBinding* in, const SmplxppBindingGradients* g, int threads) { return guarded([&] {
    const bool to_frames = g->corners || g->rotations || g->frame_quats || g->lengths;
    for_gaussians(in->face, in->N, in->F, to_frames, threads, [&](int64_t i, int) {
        const float u = in->barycentric[2 * i], v = in->barycentric[2 * i + 1];
        Vec local = load(in->offset + 3 * i);
        local.x += in->normal_offset[i];
        const float s1 = std::exp(in->log_scales[2 * i]), s2 = std::exp(in->log_scales[2 * i + 1]);
        const float* r = in->quats + 4 * i;
        float gu = 0, gv = 0, gs1 = 0, gs2 = 0, gr[4] = {};
        Vec g_local{0, 0, 0};
        for (int64_t b = 0; b < in->B; ++b) {
            const int64_t f = b * in->F + in->face[i], o = b * in->N + i;
            const float *corner = in->corners + 9 * f, *q = in->frame_quats + 4 * f;
            const Vec gm = load_or_zero(g->means, o), gs = load_or_zero(g->scales, o);
            const Vec third = load(corner + 6);
            gu += dot(gm, load(corner) - third), gv += dot(gm, load(corner + 3) - third);
            g_local = g_local + turn_back(in->rotations + 9 * f, gm);
            gs1 += gs.y * in->lengths[f] * s1, gs2 += gs.z * in->lengths[f] * s2;
            if (g->corners) {
                add(g->corners + 9 * f, u * gm), add(g->corners + 9 * f + 3, v * gm);
                add(g->corners + 9 * f + 6, (1 - u - v) * gm);
            }
            if (g->rotations) add_outer(g->rotations + 9 * f, gm, local);
            if (g->lengths) g->lengths[f] += gs.x * in->thickness + gs.y * s1 + gs.z * s2;
            if (!g->quats && !g->normals) continue;
            float gq[4] = {};
            if (g->quats) std::copy(g->quats + 4 * o, g->quats + 4 * o + 4, gq);
            if (g->normals) {
                const float w = q[0] * r[0] - q[1] * r[1] - q[2] * r[2] - q[3] * r[3];
                const float x = q[0] * r[1] + q[1] * r[0] + q[2] * r[3] - q[3] * r[2];
                const float y = q[0] * r[2] - q[1] * r[3] + q[2] * r[0] + q[3] * r[1];
                const float z = q[0] * r[3] + q[1] * r[2] - q[2] * r[1] + q[3] * r[0];
                const float scale = 1.0f / (w * w + x * x + y * y + z * z);
                const Vec n = scale * Vec{w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)};
                const Vec h = 2.0f * scale * load(g->normals + 3 * o);
                const float along = dot(h, n);
                gq[0] += h.x * w + h.y * z - h.z * y - along * w, gq[1] += h.x * x + h.y * y + h.z * z - along * x;
                gq[2] += -h.x * y + h.y * x - h.z * w - along * y, gq[3] += -h.x * z + h.y * w + h.z * x - along * z;
            }
            // out = q r: the gradient to r is conj(q) g, to q it is g conj(r).
            gr[0] += q[0] * gq[0] + q[1] * gq[1] + q[2] * gq[2] + q[3] * gq[3];
            gr[1] += q[0] * gq[1] - q[1] * gq[0] - q[2] * gq[3] + q[3] * gq[2];
            gr[2] += q[0] * gq[2] + q[1] * gq[3] - q[2] * gq[0] - q[3] * gq[1];
            gr[3] += q[0] * gq[3] - q[1] * gq[2] + q[2] * gq[1] - q[3] * gq[0];
            if (g->frame_quats) {
                float* out = g->frame_quats + 4 * f;
                out[0] += gq[0] * r[0] + gq[1] * r[1] + gq[2] * r[2] + gq[3] * r[3];
                out[1] += -gq[0] * r[1] + gq[1] * r[0] - gq[2] * r[3] + gq[3] * r[2];
                out[2] += -gq[0] * r[2] + gq[1] * r[3] + gq[2] * r[0] - gq[3] * r[1];
                out[3] += -gq[0] * r[3] - gq[1] * r[2] + gq[2] * r[1] + gq[3] * r[0];
            }
        }
        if (g->barycentric) g->barycentric[2 * i] = gu, g->barycentric[2 * i + 1] = gv;
        if (g->normal_offset) g->normal_offset[i] = g_local.x;
        if (g->offset) store(g->offset + 3 * i, g_local);
        if (g->log_scales) g->log_scales[2 * i] = gs1, g->log_scales[2 * i + 1] = gs2;
        if (g->local_quats) std::copy(gr, gr + 4, g->local_quats + 4 * i);
    });
}); }

// Colours (C,N,3) of Gaussians seen from cameras (C,3); sh (N,K,3) with K = 0, 3, 8 or 15, rotations (F,3,3).
SMPLXPP_EXPORT int32_t smplxpp_colors_forward(const int64_t* face, const float* rotations, const float* dc, const float* sh,
                                           const float* means, const float* cameras, int64_t N, int64_t C, int K,
                                           float* colors, int threads) { return guarded([&] {
    const auto run = K == 0 ? colors_forward<0> : K == 3 ? colors_forward<3> : K == 8 ? colors_forward<8> : colors_forward<15>;
    run(face, rotations, dc, sh, means, cameras, N, C, colors, threads);
}); }

// Gradients that are null are not asked for. g_rotations (F,3,3) and g_cameras (threads,C,3) are added to.
SMPLXPP_EXPORT int32_t smplxpp_colors_backward(const int64_t* face, const float* rotations, const float* dc, const float* sh,
                                            const float* means, const float* cameras, const float* g_colors, int64_t N,
                                            int64_t F, int64_t C, int K, float* g_dc, float* g_sh, float* g_means,
                                            float* g_rotations, float* g_cameras, int threads) { return guarded([&] {
    const auto run = K == 0 ? colors_backward<0> : K == 3 ? colors_backward<3> : K == 8 ? colors_backward<8> : colors_backward<15>;
    run(face, rotations, dc, sh, means, cameras, g_colors, N, F, C, {g_dc, g_sh, g_means, g_rotations, g_cameras}, threads);
}); }
