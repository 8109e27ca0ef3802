// Perspective projection of Gaussians (EWA splatting: Zwicker et al. 2002, in the form of Kerbl et al. 2023).
#include <algorithm>
#include <cmath>

#include "gaussians/gaussian.hpp"
#include "gaussians/gaussian_projection.hpp"
#include "common/parallel.hpp"

namespace smplxpp::gaussian {

namespace {

// Half width and height in pixels of the box that can reach ALPHA_MIN, or false where the Gaussian is culled. Comparisons
// are written so that NaN culls.
bool project_one(const Projection& camera, const float* mean, const float* quat, const float* scale, float opacity,
                 Ellipse& ellipse, double mean2d[2], float radius[2], float& depth) {
    const Point point = camera.transformed(mean);
    depth = (float)point.z;
    if (!(depth > 0 && depth >= camera.near_plane && depth <= camera.far_plane) || !(opacity >= ALPHA_MIN)) return false;
    mean2d[0] = camera.fx * point.x * point.inv_z + camera.cx;
    mean2d[1] = camera.fy * point.y * point.inv_z + camera.cy;
    const Footprint f = camera.footprint(point, quat, scale);
    const Factor factor(f, camera.eps2d);
    if (!(factor.det > 0 && factor.det < 1e37)) return false;
    ellipse.a = (float)factor.a, ellipse.b = (float)factor.b, ellipse.c = (float)factor.c;
    ellipse.log_opacity = std::log2(opacity);
    const float reach = std::max(ellipse.log_opacity - LOG2_ALPHA_MIN, 0.0f) / (0.5f * LOG2_E);  // p^2 + q^2 on the outline, over s
    radius[0] = std::sqrt(reach * (float)factor.xx);
    radius[1] = std::sqrt(reach * (float)factor.yy);
    if (!(mean2d[0] + radius[0] > 0 && mean2d[0] - radius[0] < camera.width) ||
        !(mean2d[1] + radius[1] > 0 && mean2d[1] - radius[1] < camera.height))
        return false;
    // Zero comes with opacity = ALPHA_MIN exactly, infinity with scales beyond any use or, without blur, with none at all.
    if (!(radius[0] > 0 && radius[1] > 0 && radius[0] < 1e9f && radius[1] < 1e9f)) return false;
    if (!(ellipse.a < 1e18f && ellipse.c < 1e18f)) return false;
    const double pixel_x = std::rint(mean2d[0]), pixel_y = std::rint(mean2d[1]);
    ellipse.pixel_x = (float)pixel_x;
    ellipse.pixel_y = (float)pixel_y;
    ellipse.rest_x = (float)(mean2d[0] - ellipse.pixel_x);
    ellipse.rest_y = (float)(mean2d[1] - ellipse.pixel_y);
    return true;
}

}  // namespace

void project(const Scene& scene, const Camera& camera, Workspace& w, float* means2d, float* radii, float* depths,
             int threads) {
    const Projection projection(camera);
    Ellipse* ellipses = w.ellipses.reserve(scene.count);
    run_threads(threads, [&](int t) {
        for (int64_t i = scene.count * t / threads, end = scene.count * (t + 1) / threads; i < end; ++i) {
            double mean2d[2];
            float radius[2];
            const bool kept = project_one(projection, scene.means + 3 * i, scene.quats + 4 * i, scene.scales + 3 * i,
                                          scene.opacities[i], ellipses[i], mean2d, radius, depths[i]);
            for (int k = 0; k < 2; ++k) {
                means2d[2 * i + k] = kept ? (float)mean2d[k] : 0.0f;
                radii[2 * i + k] = kept ? radius[k] : 0.0f;
            }
        }
    });
}

}  // namespace smplxpp::gaussian
