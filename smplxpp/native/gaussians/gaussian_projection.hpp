// One Gaussian under one camera, as projecting and its derivative both need it.
#pragma once
#include <algorithm>
#include <cmath>

#include "gaussians/gaussian.hpp"

namespace smplxpp::gaussian {

struct Point {
    double x, y, z, inv_z;
};

// Rows of J W R S: the covariance on the image is [u u', u v'; u v', v v'] + eps2d I, with the Jacobian J of the
// projection at the mean, the camera's rotation W, and the Gaussian's rotation R and scales S. In double precision: in the
// gradients of a needle that is a thousand pixels long the numbers below cancel to a millionth.
struct Footprint {
    double rotation[9];        // R, from the normalised quaternion
    double quat[4], inv_norm;  // normalised quaternion, 1 / length of the given one
    double x, y, inv_z;        // clamped x and y of the mean in the camera's frame
    bool free_x, free_y;       // not clamped
    double jw_x[3], jw_y[3];   // rows of J W
    double ur[3], vr[3];       // rows of J W R
    double u[3], v[3];
};

// The inverse covariance as the ellipse holds it: s S^-1 = L' L with L = [a b; 0 c] and s = log2(e) / 2.
struct Factor {
    double xx, uv, yy, det;   // covariance, its determinant
    double a, b, c;
    double normal[3];         // u x v

    Factor(const Footprint& f, double eps) {
        const double *u = f.u, *v = f.v;
        normal[0] = u[1] * v[2] - u[2] * v[1], normal[1] = u[2] * v[0] - u[0] * v[2], normal[2] = u[0] * v[1] - u[1] * v[0];
        const double uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2], vv = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
        uv = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
        xx = uu + eps, yy = vv + eps;
        // By the Cauchy-Binet formula: a sum of squares, where xx * yy - uv^2 would cancel.
        det = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2] + eps * (uu + vv) + eps * eps;
        const double s = 0.5 * LOG2_E;
        a = std::sqrt(s * yy / det), b = -a * uv / yy, c = std::sqrt(s / yy);
    }
};

struct Projection {
    const float* view;
    double fx, fy, cx, cy;
    // The Jacobian is taken within 1.3 times the field of view: beyond it the linearisation blows up (as in gsplat).
    double x_low, x_high, y_low, y_high;
    float width, height, near_plane, far_plane, eps2d;

    explicit Projection(const Camera& camera)
        : view(camera.viewmat), fx(camera.intrinsics[0]), fy(camera.intrinsics[4]), cx(camera.intrinsics[2]),
          cy(camera.intrinsics[5]), width((float)camera.width), height((float)camera.height),
          near_plane(camera.near_plane), far_plane(camera.far_plane), eps2d(camera.eps2d) {
        const double margin_x = 0.15 * width / fx, margin_y = 0.15 * height / fy;
        x_low = -(cx / fx + margin_x);
        x_high = (width - cx) / fx + margin_x;
        y_low = -(cy / fy + margin_y);
        y_high = (height - cy) / fy + margin_y;
    }

    // The mean in the camera's frame, in double precision: 1e-7 of an image of 2000 pixels would be seen in the picture.
    Point transformed(const float* m) const {
        const double x = m[0], y = m[1], z = m[2];
        const double depth = view[8] * x + view[9] * y + view[10] * z + view[11];
        return {view[0] * x + view[1] * y + view[2] * z + view[3], view[4] * x + view[5] * y + view[6] * z + view[7], depth,
                1.0 / depth};
    }

    Footprint footprint(const Point& point, const float* quat, const float* scale) const {
        Footprint f;
        const double q0 = quat[0], q1 = quat[1], q2 = quat[2], q3 = quat[3];
        const double inv_norm = 1.0 / std::sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3);
        f.inv_norm = inv_norm;
        for (int k = 0; k < 4; ++k) f.quat[k] = quat[k] * inv_norm;
        const double w = f.quat[0], a = f.quat[1], b = f.quat[2], c = f.quat[3];
        double* r = f.rotation;
        r[0] = 1 - 2 * (b * b + c * c), r[1] = 2 * (a * b - w * c), r[2] = 2 * (a * c + w * b);
        r[3] = 2 * (a * b + w * c), r[4] = 1 - 2 * (a * a + c * c), r[5] = 2 * (b * c - w * a);
        r[6] = 2 * (a * c - w * b), r[7] = 2 * (b * c + w * a), r[8] = 1 - 2 * (a * a + b * b);
        const double z = point.z, x_z = point.x * point.inv_z, y_z = point.y * point.inv_z;
        f.inv_z = point.inv_z;
        f.free_x = x_z >= x_low && x_z <= x_high;
        f.free_y = y_z >= y_low && y_z <= y_high;
        f.x = z * std::min(x_high, std::max(x_low, x_z));
        f.y = z * std::min(y_high, std::max(y_low, y_z));
        const double jx = fx * f.inv_z, jxz = -jx * f.x * f.inv_z, jy = fy * f.inv_z, jyz = -jy * f.y * f.inv_z;
        for (int k = 0; k < 3; ++k) {
            f.jw_x[k] = jx * view[k] + jxz * view[8 + k];
            f.jw_y[k] = jy * view[4 + k] + jyz * view[8 + k];
        }
        for (int k = 0; k < 3; ++k) {
            f.ur[k] = f.jw_x[0] * r[k] + f.jw_x[1] * r[3 + k] + f.jw_x[2] * r[6 + k];
            f.vr[k] = f.jw_y[0] * r[k] + f.jw_y[1] * r[3 + k] + f.jw_y[2] * r[6 + k];
            f.u[k] = f.ur[k] * scale[k];
            f.v[k] = f.vr[k] * scale[k];
        }
        return f;
    }
};

}  // namespace smplxpp::gaussian
