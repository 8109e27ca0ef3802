// Joints of a body to the transforms that take its surface from the T-pose to the pose; smplxpp/skinning has the equations.
#include <cmath>
#include <vector>

#include "common/status.hpp"

namespace {

// R = I + a K + b K^2, a = sin t / t, b = (sin(t/2) / (t/2))^2 / 2 (Rodrigues); row-major.
void rotation_of(const double* v, double* R) {
    const double x = v[0], y = v[1], z = v[2], squared = x * x + y * y + z * z;
    const auto sinc = [](double s) { return s < 1e-4 ? 1.0 - s / 6.0 * (1.0 - s / 20.0) : std::sin(std::sqrt(s)) / std::sqrt(s); };
    const double a = sinc(squared), half = sinc(0.25 * squared), b = 0.5 * half * half, c = 1.0 - b * squared;
    const double out[9] = {c + b * x * x, b * x * y - a * z, b * x * z + a * y, b * x * y + a * z, c + b * y * y,
                           b * y * z - a * x, b * x * z - a * y, b * y * z + a * x, c + b * z * z};
    for (int k = 0; k < 9; ++k) R[k] = out[k];
}

}  // namespace

// turns (J, 3) axis-angle relative to the parent, radians; rest (J, 3) joints in the T-pose, metres; parents come before
// their children, -1 at the first; transl (3). transforms (J, 3, 4) posed from rest; features (J - 1, 9), or null: the
// rotations less the identity, which drive pose correctives.
SMPLXPP_EXPORT int32_t smplxpp_runtime_pose(int64_t J, const int32_t* parents, const double* turns, const double* rest,
                                            const double* transl, float* transforms, float* features) {
    return smplxpp::guarded([&] {
        std::vector<double> world(12 * J);  // rotation (3, 3), then where the joint is
        for (int64_t j = 0; j < J; ++j) {
            double R[9], *out = world.data() + 12 * j;
            rotation_of(turns + 3 * j, R);
            if (features && j > 0)
                for (int k = 0; k < 9; ++k) features[9 * (j - 1) + k] = (float)(R[k] - (k % 4 == 0 ? 1.0 : 0.0));
            const int32_t parent = parents[j];
            if (parent >= j) smplxpp::throw_out_of_range("parent");
            if (parent < 0) {
                for (int k = 0; k < 9; ++k) out[k] = R[k];
                for (int k = 0; k < 3; ++k) out[9 + k] = rest[3 * j + k] + transl[k];
            } else {
                const double *up = world.data() + 12 * parent, *a = rest + 3 * j, *b = rest + 3 * parent;
                for (int r = 0; r < 3; ++r) {
                    for (int c = 0; c < 3; ++c)
                        out[3 * r + c] = up[3 * r] * R[c] + up[3 * r + 1] * R[3 + c] + up[3 * r + 2] * R[6 + c];
                    out[9 + r] = up[9 + r] + up[3 * r] * (a[0] - b[0]) + up[3 * r + 1] * (a[1] - b[1]) + up[3 * r + 2] * (a[2] - b[2]);
                }
            }
            const double* at = rest + 3 * j;
            for (int r = 0; r < 3; ++r) {
                const double* row = out + 3 * r;
                for (int c = 0; c < 3; ++c) transforms[12 * j + 4 * r + c] = (float)row[c];
                transforms[12 * j + 4 * r + 3] = (float)(out[9 + r] - row[0] * at[0] - row[1] * at[1] - row[2] * at[2]);
            }
        }
    });
}

// out[rows[r]] += basis[r] coefficients, of (R, 3, E) and (E); rows are below V.
SMPLXPP_EXPORT int32_t smplxpp_runtime_basis(int64_t R, int64_t E, int64_t V, const int32_t* rows, const float* basis,
                                             const float* coefficients, float* out) {
    return smplxpp::guarded([&] {
        smplxpp::check_indices(rows, R, V);
        for (int64_t r = 0; r < R; ++r)
            for (int k = 0; k < 3; ++k) {
                const float* b = basis + (3 * r + k) * E;
                float sum = 0;
                for (int64_t e = 0; e < E; ++e) sum += b[e] * coefficients[e];
                out[3 * (int64_t)rows[r] + k] += sum;
            }
    });
}
