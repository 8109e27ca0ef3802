// Vertices that carry Gaussians, from the T-pose to the pose: the field's displacements interpolated, those of simulated
// clothes in their place, linear blend skinning; one pass.
#include "common/parallel.hpp"
#include "common/status.hpp"

namespace {

// Mirrored by avatar/runtime/kernels.py.
struct Surface {
    int64_t vertices, joints, influences, controls, neighbours;
    const int32_t* joint;      // (V, influences)
    const float* weight;       // (V, influences), rows sum to 1
    const int32_t* neighbour;  // (V, neighbours) of the controls
    const float* share;        // (V, neighbours)
};

template <int N>
void add_scaled(float* out, float scale, const float* values) {
    for (int k = 0; k < N; ++k) out[k] += scale * values[k];
}

}  // namespace

// rest (V, 3) in the T-pose; moved (controls, 3), or null without a field; cloth (V, 3) and cloth_share (V), or null:
// displacements of simulated clothes, and how much of a vertex's displacement they are; transforms (joints, 3, 4).
// posed (V, 3).
SMPLXPP_EXPORT int32_t smplxpp_runtime_surface(const Surface* in, const float* rest, const float* moved, const float* cloth,
                                               const float* cloth_share, const float* transforms, float* posed,
                                               int32_t threads) {
    return smplxpp::guarded([&] {
        smplxpp::check_indices(in->joint, in->vertices * in->influences, in->joints);
        if (moved) smplxpp::check_indices(in->neighbour, in->vertices * in->neighbours, in->controls);
        smplxpp::run_threads(threads, [&](int t) {
            for (int64_t v = in->vertices * t / threads, end = in->vertices * (t + 1) / threads; v < end; ++v) {
                float by[3] = {0, 0, 0}, m[12] = {};
                for (int64_t k = moved ? v * in->neighbours : 0; moved && k < (v + 1) * in->neighbours; ++k)
                    add_scaled<3>(by, in->share[k], moved + 3 * (int64_t)in->neighbour[k]);
                if (cloth) {
                    const float s = cloth_share[v];
                    for (int k = 0; k < 3; ++k) by[k] = (1.0f - s) * by[k] + s * cloth[3 * v + k];
                }
                for (int64_t k = v * in->influences; k < (v + 1) * in->influences; ++k) {
                    if (in->weight[k] == 0.0f) break;  // the heaviest come first
                    add_scaled<12>(m, in->weight[k], transforms + 12 * (int64_t)in->joint[k]);
                }
                const float x = rest[3 * v] + by[0], y = rest[3 * v + 1] + by[1], z = rest[3 * v + 2] + by[2];
                for (int r = 0; r < 3; ++r) posed[3 * v + r] = m[4 * r] * x + m[4 * r + 1] * y + m[4 * r + 2] * z + m[4 * r + 3];
            }
        });
    });
}
