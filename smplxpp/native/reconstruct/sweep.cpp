// How well photographs agree on a surface that is moved along its normals: normalised cross-correlation of small square
// patches in the tangent plane, seen by the cameras that each point is given (plane sweeping, Furukawa and Ponce 2010).
//
// Points are dealt to threads in chunks by index and share nothing: the same bits for any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "common/parallel.hpp"

namespace {

constexpr int64_t kChunk = 64;  // points
constexpr int kChannels = 4;    // red, green, blue, opacity

typedef float Pixel __attribute__((vector_size(16), aligned(4), may_alias));

struct Vec {
    double x, y, z;
    friend Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    friend Vec operator*(double s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
};

// A 3 x 4 projection to pixels.
struct Projection {
    const double* m;
    Vec of_direction(Vec v) const {
        return {m[0] * v.x + m[1] * v.y + m[2] * v.z, m[4] * v.x + m[5] * v.y + m[6] * v.z,
                m[8] * v.x + m[9] * v.y + m[10] * v.z};
    }
    Vec of_point(Vec p) const { return of_direction(p) + Vec{m[3], m[7], m[11]}; }
};

struct Level {
    const float* pixels;
    int width, height;
    float scale;  // of full pixels to this level's
};

// What one view sees of a patch: colours less their mean, of unit length together; samples that do not count are 0.
struct Patch {
    std::vector<Pixel> colors;
    bool counts = false;
};

struct Sweep {
    int half;
    float noise, least_opacity;

    int samples() const { return (2 * half + 1) * (2 * half + 1); }

    void fill(Patch& patch, const Level& level, const Projection& view, Vec center, Vec a, Vec b) const {
        const Vec h0 = view.of_point(center), ha = view.of_direction(a), hb = view.of_direction(b);
        Pixel sum = {};
        int valid = 0, q = 0;
        for (int i = -half; i <= half; ++i) {
            for (int j = -half; j <= half; ++j, ++q) {
                const Vec h = h0 + double(i) * ha + double(j) * hb;
                patch.colors[size_t(q)] = Pixel{};
                if (!(h.z > 0)) continue;
                const float over = level.scale / float(h.z);
                const float u = float(h.x) * over - 0.5f, v = float(h.y) * over - 0.5f;
                if (!(u >= 0 && v >= 0 && u < float(level.width - 1) && v < float(level.height - 1))) continue;
                const int x = int(u), y = int(v);
                const float du = u - float(x), dv = v - float(y);
                const float* at = level.pixels + (int64_t(y) * level.width + x) * kChannels;
                const float* below = at + int64_t(level.width) * kChannels;
                const Pixel p00 = *(const Pixel*)at, p01 = *(const Pixel*)(at + kChannels);
                const Pixel p10 = *(const Pixel*)below, p11 = *(const Pixel*)(below + kChannels);
                if (std::min(std::min(p00[3], p01[3]), std::min(p10[3], p11[3])) < least_opacity) continue;
                const Pixel top = p00 + du * (p01 - p00), bottom = p10 + du * (p11 - p10);
                Pixel value = top + dv * (bottom - top);
                value[3] = 1.0f;  // counts the sample
                patch.colors[size_t(q)] = value;
                sum += value;
                ++valid;
            }
        }
        patch.counts = 2 * valid >= q;
        if (!patch.counts) return;
        const Pixel mean = sum / float(valid);
        Pixel squares = {};
        for (Pixel& c : patch.colors) {
            if (c[3] == 0.0f) continue;
            c -= mean;
            c[3] = 0.0f;
            squares += c * c;
        }
        // The floor is the noise of photographs: patches without texture agree with nothing.
        const float length = std::sqrt(squares[0] + squares[1] + squares[2] + noise * float(valid));
        patch.counts = length > 0;
        if (!patch.counts) return;
        for (Pixel& c : patch.colors) c /= length;
    }
};

float correlation(const Patch& one, const Patch& other) {
    Pixel sum = {};
    for (size_t q = 0; q < one.colors.size(); ++q) sum += one.colors[q] * other.colors[q];
    return sum[0] + sum[1] + sum[2];
}

// The mean over the better half of the views (and one) of each one's mean agreement with the others; -1 for fewer than two.
float agreement(const std::vector<Patch>& patches, int count, std::vector<float>& own) {
    own.clear();
    for (int k = 0; k < count; ++k) {
        if (!patches[size_t(k)].counts) continue;
        float sum = 0;
        int others = 0;
        for (int j = 0; j < count; ++j) {
            if (j == k || !patches[size_t(j)].counts) continue;
            sum += correlation(patches[size_t(k)], patches[size_t(j)]);
            ++others;
        }
        if (others) own.push_back(sum / float(others));
    }
    if (own.size() < 2) return -1.0f;
    std::sort(own.begin(), own.end(), [](float a, float b) { return a > b; });
    const size_t best = std::min(own.size(), size_t((count + 1) / 2 + 1));
    float total = 0;
    for (size_t k = 0; k < best; ++k) total += own[k];
    return total / float(best);
}

double length_in_image(Vec at, Vec step) {  // pixels that a step from a projected point takes
    const double u = (at.x + step.x) / (at.z + step.z) - at.x / at.z, v = (at.y + step.y) / (at.z + step.z) - at.y / at.z;
    return std::sqrt(u * u + v * v);
}

}  // namespace

// scores (N, offsets): how well the chosen views agree on a patch at position + offset * normal; -1 where fewer than two
// see it. pixels: all levels of all views, (height, width, 4) each, at `starts`; the level of a view is the one whose pixels
// are as far apart as the patch's samples. tangents (N, 3): unit, at right angles to the normals. chosen (N, most): views,
// -1 for none.
SMPLXPP_EXPORT int32_t smplxpp_patch_sweep(
    const float* pixels, int64_t pixel_values, const int64_t* starts, const int32_t* sizes, int64_t views, int64_t levels,
    const double* projections, const double* positions, const double* normals, const double* tangents,
    const double* spacing, const int32_t* chosen, int64_t N, int64_t most, const double* offsets, int64_t offset_count,
    int32_t half, double noise, double least_opacity, float* scores, int threads) { return smplxpp::guarded([&] {
    for (int64_t k = 0; k < views * levels; ++k) {
        const int64_t values = int64_t(kChannels) * sizes[2 * k] * sizes[2 * k + 1];
        if (starts[k] < 0 || sizes[2 * k] < 1 || sizes[2 * k + 1] < 1 || starts[k] + values > pixel_values)
            throw std::out_of_range("level");
    }
    const Sweep sweep{half, float(noise), float(least_opacity)};
    smplxpp::run_threads(threads, [&](int thread) {
        std::vector<Patch> patches((size_t)most);
        for (Patch& patch : patches) patch.colors.resize((size_t)sweep.samples());
        std::vector<Level> level((size_t)most);
        std::vector<Projection> view((size_t)most);
        std::vector<float> own;
        for (int64_t first = thread * kChunk; first < N; first += threads * kChunk) {
            for (int64_t i = first; i < std::min(N, first + kChunk); ++i) {
                const Vec p{positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]};
                const Vec n{normals[3 * i], normals[3 * i + 1], normals[3 * i + 2]};
                const Vec t{tangents[3 * i], tangents[3 * i + 1], tangents[3 * i + 2]};
                const Vec s{n.y * t.z - n.z * t.y, n.z * t.x - n.x * t.z, n.x * t.y - n.y * t.x};
                const Vec a = spacing[i] * t, b = spacing[i] * s;
                int count = 0;
                for (int64_t k = 0; k < most; ++k) {
                    const int64_t which = chosen[most * i + k];
                    if (which < 0) continue;
                    if (which >= views) throw std::out_of_range("view");
                    const Projection camera{projections + 12 * which};
                    const Vec at = camera.of_point(p);
                    if (!(at.z > 0)) continue;
                    const double apart = std::max(
                        length_in_image(at, camera.of_direction(a)), length_in_image(at, camera.of_direction(b)));
                    const double wanted = std::round(std::log2(apart));  // NaN and -inf are full resolution
                    const int64_t l = wanted > 0 ? int64_t(std::min(wanted, double(levels - 1))) : 0;
                    const int64_t row = which * levels + l;
                    level[size_t(count)] = {
                        pixels + starts[row], sizes[2 * row + 1], sizes[2 * row], 1.0f / float(int64_t(1) << l)};
                    view[size_t(count++)] = camera;
                }
                for (int64_t o = 0; o < offset_count; ++o) {
                    const Vec center = p + offsets[o] * n;
                    for (int k = 0; k < count; ++k)
                        sweep.fill(patches[size_t(k)], level[size_t(k)], view[size_t(k)], center, a, b);
                    scores[offset_count * i + o] = agreement(patches, count, own);
                }
            }
        }
    });
}); }
