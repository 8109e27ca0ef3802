// What the page's renderers take: Gaussians of the world by depth, and a record of each. Built for WebAssembly alone
// (web/kernels.mjs); the rasteriser of smplxpp/native/gaussians does the same in its own way.
#include <algorithm>
#include <cfloat>
#include <cmath>
#include <cstring>
#include <vector>

#include "common/parallel.hpp"
#include "common/status.hpp"
#include "gaussians/harmonics.hpp"

namespace {

using namespace smplxpp::binding;

constexpr int RECORD = 14, BINS = 1 << 16;

// Mirrored by web/src/native/kernels.ts: N Gaussians as smplxpp_runtime_world writes them.
struct Splats {
    int64_t count, harmonics;
    const float *means, *quats, *scales, *opacities, *dc;  // (N, 3) (N, 4) (N, 3) (N) (N, 3)
    const float* sh;                                       // (N, harmonics, 3)
    const int32_t* face;                                   // (N)
    const float* rotations;                                // (F, 3, 3)
};

// xx xy xz yy yz zz of R diag(s)^2 R^T.
void covariance(const float* q, const float* s, float* out) {
    const float w = q[0], x = q[1], y = q[2], z = q[3], two = 2.0f / (w * w + x * x + y * y + z * z);
    const float R[9] = {1 - two * (y * y + z * z), two * (x * y - w * z),     two * (x * z + w * y),
                        two * (x * y + w * z),     1 - two * (x * x + z * z), two * (y * z - w * x),
                        two * (x * z - w * y),     two * (y * z + w * x),     1 - two * (x * x + y * y)};
    Vec row[3];
    for (int r = 0; r < 3; ++r) row[r] = {R[3 * r] * s[0], R[3 * r + 1] * s[1], R[3 * r + 2] * s[2]};
    out[0] = dot(row[0], row[0]), out[1] = dot(row[0], row[1]), out[2] = dot(row[0], row[2]);
    out[3] = dot(row[1], row[1]), out[4] = dot(row[1], row[2]), out[5] = dot(row[2], row[2]);
}

// Cosine beyond which a surface that turns away shows its inner side (avatar/runtime/relighting.py).
constexpr float AWAY = 0.35f;
constexpr float HALF = 2047.0f;  // of twelve bits

// A unit normal as one whole number that a float holds exactly: the octahedron unfolded onto a square of 4095 x 4095, as
// Cigolle et al. 2014 describe it. Where there is none: 0.
float folded(Vec n) {
    const float sum = std::abs(n.x) + std::abs(n.y) + std::abs(n.z);
    if (!(sum > 0.0f)) return 0.0f;
    float u = n.x / sum, v = n.y / sum;
    if (n.z < 0.0f) {
        const float over = (1.0f - std::abs(v)) * (u < 0.0f ? -1.0f : 1.0f);
        v = (1.0f - std::abs(u)) * (v < 0.0f ? -1.0f : 1.0f), u = over;
    }
    return 4096.0f * (std::round(HALF * u) + HALF + 1.0f) + std::round(HALF * v) + HALF + 1.0f;
}

// Those of the Gaussians from `i` to `end`.
template <int K>
void write(const Splats& in, Vec eye, const float* normals, int64_t i, int64_t end, float* all) {
    [[maybe_unused]] float basis[15];
    for (float* out = all + RECORD * i; i < end; ++i, out += RECORD) {
        const Vec mean = load(in.means + 3 * i);
        Vec color = load(in.dc + 3 * i);
        if constexpr (K > 0) {
            const Vec away = mean - eye;
            const Vec along = (1.0f / length(away)) * away;
            color = color_before_clamp<K>(turn_back(in.rotations + 9 * (int64_t)in.face[i], along), color, in.sh + 3 * K * i, basis);
        }
        store(out, mean);
        out[3] = in.opacities[i];
        covariance(in.quats + 4 * i, in.scales + 3 * i, out + 4);
        store(out + 10, {std::max(color.x, 0.0f), std::max(color.y, 0.0f), std::max(color.z, 0.0f)});
        out[13] = 0.0f;
        if (normals) {
            const Vec normal = load(normals + 3 * i), away = mean - eye;
            out[13] = folded(dot(normal, away) > AWAY * length(away) ? -1.0f * normal : normal);
        }
    }
}

}  // namespace

// Centre, opacity, covariance, colour and normal of `rows` Gaussians in an order, as an eye (3, metres) sees them: records
// (rows, 14). normals (N, 3) or null: nobody asks for them. scratch (N, 14).
SMPLXPP_EXPORT int32_t smplxpp_web_records(const Splats* in, const float* eye, const float* normals, const uint32_t* order, int64_t rows,
                                           float* scratch, float* records, int32_t threads) {
    return smplxpp::guarded([&] {
        smplxpp::check_indices(order, rows, in->count);
        const Vec from = load(eye);
        const auto writer = [&]() -> decltype(&write<0>) {
            switch (in->harmonics) {
                case 0: return write<0>;
                case 3: return write<3>;
                case 8: return write<8>;
                case 15: return write<15>;
                default: smplxpp::throw_out_of_range("harmonics");
            }
        }();
        // All of them as they lie in memory, then into the order: one jump in memory for each instead of eight.
        smplxpp::run_threads(threads, [&](int t) {
            writer(*in, from, normals, in->count * t / threads, in->count * (t + 1) / threads, scratch);
        });
        smplxpp::run_threads(threads, [&](int t) {
            for (int64_t r = rows * t / threads, end = rows * (t + 1) / threads; r < end; ++r)
                std::memcpy(records + RECORD * r, scratch + RECORD * order[r], RECORD * sizeof(float));
        });
    });
}

// Those of N Gaussians that lie before a camera's near plane and whose part is shown, where `sorted` by depth in 16 bits,
// nearest first. row (4): what of the view gives a depth; part (N), hidden (by part). Writes order (as many as it says in
// `count`) and the least and largest depth (2), metres.
SMPLXPP_EXPORT int32_t smplxpp_web_order(int64_t N, const float* means, const float* row, float near, const uint8_t* part,
                                         const uint8_t* hidden, int32_t sorted, uint32_t* order, float* range, int32_t* count) {
    return smplxpp::guarded([&] {
        std::vector<float> depths(N);
        std::vector<uint32_t> shown(N), first(BINS + 1, 0);
        int64_t n = 0;
        float least = FLT_MAX, most = -FLT_MAX;
        for (int64_t i = 0; i < N; ++i) {
            const float* p = means + 3 * i;
            const float z = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
            if (!(z >= near) || hidden[part[i]]) continue;
            depths[n] = z, shown[n++] = (uint32_t)i;
            least = std::min(least, z), most = std::max(most, z);
        }
        *count = (int32_t)n;
        range[0] = n ? least : 0.0f, range[1] = n ? most : 1.0f;
        if (!sorted) {
            std::copy(shown.begin(), shown.begin() + n, order);
            return;
        }
        const float scale = most > least ? (BINS - 1) / (most - least) : 0.0f;
        const auto key = [&](int64_t k) { return (uint32_t)((depths[k] - least) * scale) & (BINS - 1); };
        for (int64_t k = 0; k < n; ++k) ++first[key(k) + 1];
        for (int bin = 0; bin < BINS; ++bin) first[bin + 1] += first[bin];
        for (int64_t k = 0; k < n; ++k) order[first[key(k)]++] = shown[k];
    });
}
