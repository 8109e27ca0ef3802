// Real spherical harmonics of degrees 1 to 3 in the order of 3D Gaussian Splatting, and their gradient; K = 0, 3, 8, 15.
#pragma once
#include "gaussians/binding_math.hpp"

namespace smplxpp::binding {

constexpr float kC1 = 0.4886025119029199f;
constexpr float kC2[3] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
constexpr float kC3[5] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f,
                          1.445305721320277f};

template <int K>
void basis([[maybe_unused]] Vec d, [[maybe_unused]] float* y) {
    [[maybe_unused]] const float X = d.x, Y = d.y, Z = d.z, xx = X * X, yy = Y * Y, zz = Z * Z;
    if constexpr (K >= 3) y[0] = -kC1 * Y, y[1] = kC1 * Z, y[2] = -kC1 * X;
    if constexpr (K >= 8) {
        y[3] = kC2[0] * X * Y, y[4] = -kC2[0] * Y * Z, y[5] = kC2[1] * (2 * zz - xx - yy);
        y[6] = -kC2[0] * X * Z, y[7] = kC2[2] * (xx - yy);
    }
    if constexpr (K >= 15) {
        y[8] = -kC3[0] * Y * (3 * xx - yy), y[9] = kC3[1] * X * Y * Z, y[10] = -kC3[2] * Y * (4 * zz - xx - yy);
        y[11] = kC3[3] * Z * (2 * zz - 3 * xx - 3 * yy), y[12] = -kC3[2] * X * (4 * zz - xx - yy);
        y[13] = kC3[4] * Z * (xx - yy), y[14] = -kC3[0] * X * (xx - 3 * yy);
    }
}

// Gradient to d of sum_k c_k Y_k(d).
template <int K>
Vec basis_gradient(Vec d, const float* c) {
    const float X = d.x, Y = d.y, Z = d.z, xx = X * X, yy = Y * Y, zz = Z * Z;
    Vec g{0, 0, 0};
    if constexpr (K >= 3) g = {-kC1 * c[2], -kC1 * c[0], kC1 * c[1]};
    if constexpr (K >= 8) {
        const float a = kC2[0], b = kC2[1], e = kC2[2];
        g.x += a * c[3] * Y - 2 * b * c[5] * X - a * c[6] * Z + 2 * e * c[7] * X;
        g.y += a * c[3] * X - a * c[4] * Z - 2 * b * c[5] * Y - 2 * e * c[7] * Y;
        g.z += -a * c[4] * Y + 4 * b * c[5] * Z - a * c[6] * X;
    }
    if constexpr (K >= 15) {
        const float p = kC3[0] * c[8], q = kC3[1] * c[9], r = kC3[2] * c[10], s = kC3[3] * c[11], t = kC3[2] * c[12],
                    u = kC3[4] * c[13], v = kC3[0] * c[14];
        g.x += -6 * p * X * Y + q * Y * Z + 2 * r * X * Y - 6 * s * X * Z - t * (4 * zz - 3 * xx - yy) + 2 * u * X * Z -
               3 * v * (xx - yy);
        g.y += -3 * p * (xx - yy) + q * X * Z - r * (4 * zz - xx - 3 * yy) - 6 * s * Y * Z + 2 * t * X * Y -
               2 * u * Y * Z + 6 * v * X * Y;
        g.z += q * X * Y - 8 * r * Y * Z + s * (6 * zz - 3 * xx - 3 * yy) - 8 * t * X * Z + u * (xx - yy);
    }
    return g;
}

template <int K>
Vec color_before_clamp(Vec direction, Vec dc, const float* sh, float* y) {
    basis<K>(direction, y);
    for (int k = 0; k < K; ++k) dc = dc + y[k] * load(sh + 3 * k);
    return dc;
}

}  // namespace smplxpp::binding
