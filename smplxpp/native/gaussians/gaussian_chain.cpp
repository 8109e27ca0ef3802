// From the sums over pixels to the parameters of each Gaussian. With L = [a b; 0 c], so that (p, q) = L d, the derivatives
// of the ellipse follow without inverting anything (s = log2(e) / 2, Sigma the covariance on the image, M the second moments
// of v in (p, q)):
//   dL/dmean = L' (sum v p, sum v q) / s,     dL/dSigma = L' M L / (2 s^2);
// Sigma is U' U + eps I with U = [u v], so dL/dU = 2 U dL/dSigma = (U L') M L / s^2. U L' is small where U and L are large,
// as in a needle: it is formed from the cross product of u and v, and not as a product that would cancel. The rest is the
// derivative of gaussian_projection.hpp, line by line backwards, in double precision for the same reason.
#include <array>
#include <cmath>

#include "gaussians/gaussian.hpp"
#include "gaussians/gaussian_projection.hpp"
#include "common/parallel.hpp"

namespace smplxpp::gaussian {

namespace {

struct OneGradient {
    float mean[3], quat[4], scale[3], opacity;
};

using PoseGradient = std::array<double, 12>;  // (3, 4), row by row

OneGradient chain_one(const Projection& camera, const Scene& scene, int64_t i, const float* m, PoseGradient* pose) {
    const double s = 0.5 * LOG2_E;
    const float* V = camera.view;
    OneGradient out;
    out.opacity = m[0] / scene.opacities[i];
    const Point point = camera.transformed(scene.means + 3 * i);
    const float* scale = scene.scales + 3 * i;
    const Footprint f = camera.footprint(point, scene.quats + 4 * i, scale);
    const Factor e(f, camera.eps2d);
    const double to_x = e.a * m[1] / s, to_y = (e.b * m[1] + e.c * m[2]) / s;  // dL/dmean on the image
    // Columns of U L': a u + b v = a (eps u + v x (u x v)) / yy, and c v.
    const double *u = f.u, *v = f.v, *n = e.normal, *R = f.rotation;
    const double across[3] = {v[1] * n[2] - v[2] * n[1], v[2] * n[0] - v[0] * n[2], v[0] * n[1] - v[1] * n[0]};
    const double k = 1 / (s * s), ratio = e.a / e.yy;
    double to_R[9], to_jx[3] = {0, 0, 0}, to_jy[3] = {0, 0, 0};
    for (int j = 0; j < 3; ++j) {
        const double up = ratio * (camera.eps2d * u[j] + across[j]), uq = e.c * v[j];
        const double mp = k * (up * m[3] + uq * m[4]), mq = k * (up * m[4] + uq * m[5]);
        const double to_u = mp * e.a, to_v = mp * e.b + mq * e.c;
        out.scale[j] = (float)(to_u * f.ur[j] + to_v * f.vr[j]);
        const double to_ur = to_u * scale[j], to_vr = to_v * scale[j];
        for (int r = 0; r < 3; ++r) {
            to_R[3 * r + j] = f.jw_x[r] * to_ur + f.jw_y[r] * to_vr;
            to_jx[r] += R[3 * r + j] * to_ur;
            to_jy[r] += R[3 * r + j] * to_vr;
        }
    }
    const double fx = camera.fx, fy = camera.fy, iz = f.inv_z, iz2 = iz * iz;
    const double jx = fx * iz, jxz = -jx * f.x * iz, jy = fy * iz, jyz = -jy * f.y * iz;
    double to_j[4] = {0, 0, 0, 0};  // of jx, jxz, jy, jyz
    for (int r = 0; r < 3; ++r) {
        to_j[0] += to_jx[r] * V[r];
        to_j[1] += to_jx[r] * V[8 + r];
        to_j[2] += to_jy[r] * V[4 + r];
        to_j[3] += to_jy[r] * V[8 + r];
    }
    double to_point[3] = {to_x * jx, to_y * jy, -(to_x * jx * point.x + to_y * jy * point.y) * iz};
    to_point[2] -= fx * iz2 * to_j[0] + fy * iz2 * to_j[2];
    // A clamped x is proportional to z, so that jxz falls with 1/z there, else with 1/z^2.
    to_point[2] += (f.free_x ? 2 : 1) * fx * f.x * iz2 * iz * to_j[1] + (f.free_y ? 2 : 1) * fy * f.y * iz2 * iz * to_j[3];
    if (f.free_x) to_point[0] -= fx * iz2 * to_j[1];
    if (f.free_y) to_point[1] -= fy * iz2 * to_j[3];
    for (int j = 0; j < 3; ++j) out.mean[j] = (float)(V[j] * to_point[0] + V[4 + j] * to_point[1] + V[8 + j] * to_point[2]);
    if (pose) {
        const float* mean = scene.means + 3 * i;
        for (int j = 0; j < 3; ++j) {
            (*pose)[j] += to_point[0] * mean[j] + jx * to_jx[j];
            (*pose)[4 + j] += to_point[1] * mean[j] + jy * to_jy[j];
            (*pose)[8 + j] += to_point[2] * mean[j] + jxz * to_jx[j] + jyz * to_jy[j];
        }
        for (int r = 0; r < 3; ++r) (*pose)[4 * r + 3] += to_point[r];
    }
    const double w = f.quat[0], a = f.quat[1], b = f.quat[2], c = f.quat[3];
    const double to_q[4] = {
        2 * (c * (to_R[3] - to_R[1]) + b * (to_R[2] - to_R[6]) + a * (to_R[7] - to_R[5])),
        2 * (-2 * a * (to_R[4] + to_R[8]) + b * (to_R[1] + to_R[3]) + c * (to_R[2] + to_R[6]) + w * (to_R[7] - to_R[5])),
        2 * (a * (to_R[1] + to_R[3]) - 2 * b * (to_R[0] + to_R[8]) + c * (to_R[5] + to_R[7]) + w * (to_R[2] - to_R[6])),
        2 * (a * (to_R[2] + to_R[6]) + b * (to_R[5] + to_R[7]) - 2 * c * (to_R[0] + to_R[4]) + w * (to_R[3] - to_R[1]))};
    const double along = to_q[0] * w + to_q[1] * a + to_q[2] * b + to_q[3] * c;
    for (int j = 0; j < 4; ++j) out.quat[j] = (float)((to_q[j] - along * f.quat[j]) * f.inv_norm);
    return out;
}

template <int n>
inline void put(float* out, const float* value, bool add) {
    for (int j = 0; j < n; ++j) out[j] = add ? out[j] + value[j] : value[j];
}

}  // namespace

void chain(const Scene& scene, const Camera& camera, const Workspace& w, const float* radii, const Gradients& gradients, int threads) {
    const Projection projection(camera);
    const int D = scene.channels;
    const int64_t stride = (int64_t)LANES_OF_ROW * row_groups(D);
    std::vector<PoseGradient> poses(threads, PoseGradient{});
    run_threads(threads, [&](int t) {
        std::vector<float> sum(stride), nothing(stride, 0.0f);
        for (int64_t i = scene.count * t / threads, end = scene.count * (t + 1) / threads; i < end; ++i) {
            OneGradient one = {};
            const float* row = nothing.data();
            if (radii[2 * i] > 0) {
                const Workspace::Owners o = w.owners[i];
                row = &w.rows[i * stride];
                if (o.first != o.last) {
                    std::copy(row, row + stride, sum.begin());
                    for (int64_t extra = o.extra; extra < (int64_t)o.extra + o.last - o.first; ++extra) {
                        for (int64_t j = 0; j < stride; ++j) sum[j] += w.rows[extra * stride + j];
                    }
                    row = sum.data();
                }
                one = chain_one(projection, scene, i, row, gradients.viewmat ? &poses[t] : nullptr);
            }
            put<3>(gradients.means + 3 * i, one.mean, gradients.accumulate);
            put<4>(gradients.quats + 4 * i, one.quat, gradients.accumulate);
            put<3>(gradients.scales + 3 * i, one.scale, gradients.accumulate);
            put<1>(gradients.opacities + i, &one.opacity, gradients.accumulate);
            float* to_f = gradients.features + i * D;
            for (int j = 0; j < D; ++j) to_f[j] = row[MOMENTS + j] + (gradients.accumulate_features ? to_f[j] : 0.0f);
        }
    });
    if (gradients.viewmat) {
        for (const PoseGradient& pose : poses) {
            for (int j = 0; j < 12; ++j) gradients.viewmat[j] += pose[j];
        }
    }
}

}  // namespace smplxpp::gaussian
