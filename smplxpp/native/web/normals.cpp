// Normals of the posed surface where Gaussians hang on it, for pictures in another light: what AvatarPlayer.normals does
// in numpy. Built for WebAssembly alone (web/kernels.mjs).
#include <algorithm>
#include <cmath>

#include "common/status.hpp"
#include "gaussians/binding_math.hpp"

namespace {

using namespace smplxpp::binding;

// Nothing where there is no direction.
Vec unit(Vec v) {
    const float size = length(v);
    return size > 0.0f ? (1.0f / size) * v : Vec{0.0f, 0.0f, 0.0f};
}

}  // namespace

// posed (V, 3), metres; faces (F, 3), first (F + 1) a triangle's first Gaussian; barycentric (N, 2). Writes the unit normals of
// the vertices (V, 3), triangles weighted by their angle there (Thuermer and Wuethrich 1998), and those of the Gaussians (N, 3).
SMPLXPP_EXPORT int32_t smplxpp_web_normals(int64_t V, int64_t F, const float* posed, const int32_t* faces, const int32_t* first,
                                           const float* barycentric, float* corners, float* normals) {
    return smplxpp::guarded([&] {
        smplxpp::check_indices(faces, 3 * F, V);
        std::fill(corners, corners + 3 * V, 0.0f);
        for (int64_t f = 0; f < F; ++f) {
            Vec at[3];
            for (int k = 0; k < 3; ++k) at[k] = load(posed + 3 * (int64_t)faces[3 * f + k]);
            const Vec normal = unit(cross(at[1] - at[0], at[2] - at[0]));
            for (int k = 0; k < 3; ++k) {
                const Vec u = unit(at[(k + 1) % 3] - at[k]), v = unit(at[(k + 2) % 3] - at[k]);
                float* out = corners + 3 * (int64_t)faces[3 * f + k];
                store(out, load(out) + std::atan2(length(cross(u, v)), dot(u, v)) * normal);
            }
        }
        for (int64_t v = 0; v < V; ++v) store(corners + 3 * v, unit(load(corners + 3 * v)));
        for (int64_t f = 0; f < F; ++f) {
            Vec of[3];
            for (int k = 0; k < 3; ++k) of[k] = load(corners + 3 * (int64_t)faces[3 * f + k]);
            for (int64_t i = first[f]; i < first[f + 1]; ++i) {
                const float u = barycentric[2 * i], v = barycentric[2 * i + 1];
                store(normals + 3 * i, unit(u * of[0] + v * of[1] + (1.0f - u - v) * of[2]));
            }
        }
    });
}
