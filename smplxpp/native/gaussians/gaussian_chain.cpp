// From the sums over pixels to the parameters of each Gaussian. With L = [a b; 0 c], so that (p, q) = L d, the derivatives
// of the ellipse follow without inverting anything (s = log2(e) / 2, Sigma the covariance on the image):
//   dL/dmean = L' (sum v p, sum v q) / s,     dL/dSigma = L' M L / (2 s^2),   M the second moments of v in (p, q);
// the rest is the derivative of gaussian_projection.hpp, line by line backwards.
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

OneGradient chain_one(const Projection& camera, const Scene& scene, int64_t i, const Ellipse& e, const float* m, PoseGradient* pose) {
    const float s = 0.5f * LOG2_E, k = 0.5f / (s * s);
    const float* V = camera.view;
    OneGradient out;
    out.opacity = m[0] / scene.opacities[i];
    const float to_x = e.a * m[1] / s, to_y = (e.b * m[1] + e.c * m[2]) / s;  // dL/dmean on the image
    // dL/dSigma; `xy` stands for both off-diagonal entries together.
    const float xx = k * e.a * e.a * m[3], xy = 2 * k * e.a * (e.b * m[3] + e.c * m[4]),
                yy = k * (e.b * e.b * m[3] + 2 * e.b * e.c * m[4] + e.c * e.c * m[5]);
    const Point point = camera.transformed(scene.means + 3 * i);
    const float* scale = scene.scales + 3 * i;
    const Footprint f = camera.footprint(point, scene.quats + 4 * i, scale);
    const float* R = f.rotation;
    float to_R[9], to_jx[3] = {0, 0, 0}, to_jy[3] = {0, 0, 0};
    for (int j = 0; j < 3; ++j) {
        const float to_u = 2 * xx * f.u[j] + xy * f.v[j], to_v = 2 * yy * f.v[j] + xy * f.u[j];
        out.scale[j] = to_u * f.ur[j] + to_v * f.vr[j];
        const float to_ur = to_u * scale[j], to_vr = to_v * scale[j];
        for (int r = 0; r < 3; ++r) {
            to_R[3 * r + j] = f.jw_x[r] * to_ur + f.jw_y[r] * to_vr;
            to_jx[r] += R[3 * r + j] * to_ur;
            to_jy[r] += R[3 * r + j] * to_vr;
        }
    }
    const float fx = (float)camera.fx, fy = (float)camera.fy, iz = f.inv_z, iz2 = iz * iz;
    const float jx = fx * iz, jxz = -jx * f.x * iz, jy = fy * iz, jyz = -jy * f.y * iz;
    float to_j[4] = {0, 0, 0, 0};  // of jx, jxz, jy, jyz
    for (int r = 0; r < 3; ++r) {
        to_j[0] += to_jx[r] * V[r];
        to_j[1] += to_jx[r] * V[8 + r];
        to_j[2] += to_jy[r] * V[4 + r];
        to_j[3] += to_jy[r] * V[8 + r];
    }
    const float x = (float)point.x, y = (float)point.y;
    float to_point[3] = {to_x * jx, to_y * jy, -(to_x * jx * x + to_y * jy * y) * iz};
    to_point[2] -= fx * iz2 * to_j[0] + fy * iz2 * to_j[2];
    // A clamped x is proportional to z, so that jxz falls with 1/z there, else with 1/z^2.
    to_point[2] += (f.free_x ? 2 : 1) * fx * f.x * iz2 * iz * to_j[1] + (f.free_y ? 2 : 1) * fy * f.y * iz2 * iz * to_j[3];
    if (f.free_x) to_point[0] -= fx * iz2 * to_j[1];
    if (f.free_y) to_point[1] -= fy * iz2 * to_j[3];
    for (int j = 0; j < 3; ++j) out.mean[j] = V[j] * to_point[0] + V[4 + j] * to_point[1] + V[8 + j] * to_point[2];
    if (pose) {
        const float* mean = scene.means + 3 * i;
        for (int j = 0; j < 3; ++j) {
            (*pose)[j] += (double)to_point[0] * mean[j] + (double)jx * to_jx[j];
            (*pose)[4 + j] += (double)to_point[1] * mean[j] + (double)jy * to_jy[j];
            (*pose)[8 + j] += (double)to_point[2] * mean[j] + (double)jxz * to_jx[j] + (double)jyz * to_jy[j];
        }
        for (int r = 0; r < 3; ++r) (*pose)[4 * r + 3] += to_point[r];
    }
    const float w = f.quat[0], a = f.quat[1], b = f.quat[2], c = f.quat[3];
    const float to_q[4] = {
        2 * (c * (to_R[3] - to_R[1]) + b * (to_R[2] - to_R[6]) + a * (to_R[7] - to_R[5])),
        2 * (-2 * a * (to_R[4] + to_R[8]) + b * (to_R[1] + to_R[3]) + c * (to_R[2] + to_R[6]) + w * (to_R[7] - to_R[5])),
        2 * (a * (to_R[1] + to_R[3]) - 2 * b * (to_R[0] + to_R[8]) + c * (to_R[5] + to_R[7]) + w * (to_R[2] - to_R[6])),
        2 * (a * (to_R[2] + to_R[6]) + b * (to_R[5] + to_R[7]) - 2 * c * (to_R[0] + to_R[4]) + w * (to_R[3] - to_R[1]))};
    const float along = to_q[0] * w + to_q[1] * a + to_q[2] * b + to_q[3] * c;
    for (int j = 0; j < 4; ++j) out.quat[j] = (to_q[j] - along * f.quat[j]) * f.inv_norm;
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
    Failure failure;
    run_threads(threads, [&](int t) { failure.guard([&] {
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
                one = chain_one(projection, scene, i, w.ellipses[i], row, gradients.viewmat ? &poses[t] : nullptr);
            }
            put<3>(gradients.means + 3 * i, one.mean, gradients.accumulate);
            put<4>(gradients.quats + 4 * i, one.quat, gradients.accumulate);
            put<3>(gradients.scales + 3 * i, one.scale, gradients.accumulate);
            put<1>(gradients.opacities + i, &one.opacity, gradients.accumulate);
            float* to_f = gradients.features + i * D;
            for (int j = 0; j < D; ++j) to_f[j] = row[MOMENTS + j] + (gradients.accumulate_features ? to_f[j] : 0.0f);
        }
    }); });
    failure.rethrow();
    if (gradients.viewmat) {
        for (const PoseGradient& pose : poses) {
            for (int j = 0; j < 12; ++j) gradients.viewmat[j] += pose[j];
        }
    }
}

}  // namespace smplxpp::gaussian
