// Structural similarity of two images and its gradient in one sweep, 11x11 Gaussian window of sigma 1.5.
//
// With mu the windowed means, d = x - y, and S = var(x) + var(y) in the window, SSIM is written as
//     (1 - (mu_x - mu_y)^2 / (mu_x^2 + mu_y^2 + C1)) (1 - var(d) / (S + C2)),
// which equals the usual form since var(d) = S - 2 cov(x, y). It needs four windowed means (x, y, x^2 + y^2, d^2) instead
// of five, and loses no digits where the images agree. The gradient blurs the weighted partial derivatives by those means
// with the same window, so it takes three more blurs (four for both images).
//
// An image is cut into tiles of fixed size that are dealt to threads by index: no result depends on the thread count.
// A tile goes down its rows in blocks with everything it needs in rings of rows that stay in the cache; nothing but the
// gradient is kept for the backward pass.
#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "common/parallel.hpp"

namespace {

constexpr int kHalf = 5;                  // the window reaches this many pixels from its centre
constexpr int kWindow = 2 * kHalf + 1;
constexpr int kBlock = 4;                 // rows blurred at once
constexpr int kSpan = kBlock + 2 * kHalf; // rows that such a block needs
constexpr int kRing = 16;                 // rows kept, a multiple of kBlock and at least kSpan
constexpr int kTileRows = 128, kTileFloats = 768; // about the size of a tile without its halo
constexpr int kVector = 16;               // loops over scratch rows run over whole vectors of so many floats
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// Subtracted from both images before squaring: variances do not change and their cancellation costs fewer digits.
constexpr float kShift = 0.5f;
// exp(-k^2 / (2 sigma^2)) normalised to sum 1, k = -5..5.
constexpr float kTap[kWindow] = {0.00102838008f, 0.00759875813f, 0.03600077213f, 0.10936068950f, 0.21300553771f, 0.26601172486f,
                                 0.21300553771f, 0.10936068950f, 0.03600077213f, 0.00759875813f, 0.00102838008f};

struct Images {
    const float *x, *y; // (H,W,C)
    const float* weight; // (H,W,weight_channels) or null for 1; weight_channels is 1 or C
    float *map, *grad_x, *grad_y; // (H,W,C) or null
    int height, width, channels, weight_channels;
    int border; // pixels at the image's rim whose weight is 0
    float scale; // of the weights
};

constexpr int whole_vectors(int n) { return (n + kVector - 1) / kVector * kVector; }

constexpr float tap(int k) { return k >= 0 && k < kWindow ? kTap[k] : 0.0f; }

// out[r][i] = sum_k tap(k) rows[r + k][i] for the kBlock rows r: every input row is loaded once, and the terms whose tap is
// 0 are gone at compile time.
template <int... K>
void blur_down(const float* const* rows, float* out, size_t stride, int n, std::integer_sequence<int, K...>) {
    static_assert(kBlock == 4);
    const float* const row[] = {rows[K]...};
    float *o0 = out, *o1 = out + stride, *o2 = out + 2 * stride, *o3 = out + 3 * stride;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const float v[] = {row[K][i]...};
        o0[i] = ((tap(K) * v[K]) + ...);
        o1[i] = ((tap(K - 1) * v[K]) + ...);
        o2[i] = ((tap(K - 2) * v[K]) + ...);
        o3[i] = ((tap(K - 3) * v[K]) + ...);
    }
}

// out[i] = sum_k tap[k] in[i + k channels]
void blur_across(const float* __restrict in, float* __restrict out, int n, int channels) {
    const size_t c = size_t(channels);
    for (int i = 0; i < n; ++i) {
        const float* v = in + i;
        out[i] = kTap[0] * (v[0] + v[10 * c]) + kTap[1] * (v[c] + v[9 * c]) + kTap[2] * (v[2 * c] + v[8 * c]) +
                 kTap[3] * (v[3 * c] + v[7 * c]) + kTap[4] * (v[4 * c] + v[6 * c]) + kTap[5] * v[5 * c];
    }
}

// Rings of rows of several quantities ("planes"), and kBlock of those rows blurred both ways.
struct Blur {
    size_t stride;
    int planes;
    std::vector<float> ring, down, out;

    Blur(int planes_, int row) : stride(size_t(whole_vectors(row)) + kVector), planes(planes_), ring(planes_ * kRing * stride),
                                    down(kBlock * stride), out(planes_ * kBlock * stride) {}
    float* row(int plane, int k) { return ring.data() + size_t(plane * kRing + k % kRing) * stride; }
    float* blurred(int plane, int r) { return out.data() + size_t(plane * kBlock + r) * stride; }

    // Blurs rows k .. k + kBlock - 1 + 2 kHalf of the ring, n floats after the blur.
    void run(int k, int n, int channels) {
        for (int p = 0; p < planes; ++p) {
            const float* rows[kSpan];
            for (int j = 0; j < kSpan; ++j) rows[j] = row(p, k + j);
            blur_down(rows, down.data(), stride, whole_vectors(n + 2 * kHalf * channels), std::make_integer_sequence<int, kSpan>());
            for (int r = 0; r < kBlock; ++r) blur_across(down.data() + r * stride, blurred(p, r), whole_vectors(n), channels);
        }
    }
};

class Tile {
public:
    Tile(int channels, int tile_columns, bool gradient, bool both)
        : channels_(channels), halo_(gradient ? kHalf : 0), partials_(gradient ? (both ? 4 : 3) : 0),
          input_(4, (tile_columns + 2 * halo_ + 2 * kHalf) * channels),
          partial_(partials_, (tile_columns + 2 * halo_) * channels),
          weight_(input_.stride), value_(input_.stride) {}

    // Rows [r0, r1), columns [c0, c1): writes the map and the gradients asked for, returns the weighted sum.
    double run(const Images& im, int r0, int r1, int c0, int c1) {
        r0_ = r0, r1_ = r1, c0_ = c0, c1_ = c1;
        const int blocks = (r1 - r0 + 2 * halo_ + kBlock - 1) / kBlock;
        const int ahead = kRing / kBlock - 1;
        double sum = 0;
        // Ring index k is image row r0 - halo - kHalf + k of the input, r0 - halo + k of the partials.
        for (int k = 0; k < ahead * kBlock; ++k) load(im, k);
        for (int b = 0; b < blocks; ++b) {
            for (int k = 0; k < kBlock; ++k) load(im, (b + ahead) * kBlock + k);
            sum += similarity(im, b * kBlock);
            if (halo_ && b >= ahead) gradient(im, (b - ahead) * kBlock);
        }
        for (int b = blocks; halo_ && b < blocks + ahead; ++b) gradient(im, (b - ahead) * kBlock);
        return sum;
    }

private:
    // One row of the four quantities to blur.
    void load(const Images& im, int k) {
        const int row = r0_ - halo_ - kHalf + k, first = c0_ - halo_ - kHalf;
        const int n = (c1_ - c0_ + 2 * halo_ + 2 * kHalf) * channels_;
        float *__restrict x = input_.row(0, k), *__restrict y = input_.row(1, k);
        float *__restrict squares = input_.row(2, k), *__restrict difference = input_.row(3, k);
        const bool inside = row >= 0 && row < im.height;
        const int begin = inside ? std::max(0, -first) * channels_ : n;
        const int end = inside ? std::min(n, (im.width - first) * channels_) : n;
        const auto outside = [&](int from, int to) {
            std::fill(x + from, x + to, 0.0f), std::fill(y + from, y + to, 0.0f);
            std::fill(squares + from, squares + to, 2 * kShift * kShift), std::fill(difference + from, difference + to, 0.0f);
        };
        outside(0, begin), outside(end, n);
        const ptrdiff_t offset = (ptrdiff_t(row) * im.width + first) * channels_;
#pragma GCC ivdep
        for (int i = begin; i < end; ++i) {
            const float u = im.x[offset + i], v = im.y[offset + i];
            x[i] = u, y[i] = v, difference[i] = (u - v) * (u - v);
            squares[i] = (u - kShift) * (u - kShift) + (v - kShift) * (v - kShift);
        }
    }

    // Weights of the pixels of one row, 0 outside of the image and on its border.
    void load_weights(const Images& im, int row, int first, int n) {
        const int begin = std::min(n, std::max(0, im.border - first) * channels_);
        const int end = std::max(begin, std::min(n, (im.width - im.border - first) * channels_));
        std::fill_n(weight_.begin(), begin, 0.0f), std::fill(weight_.begin() + end, weight_.begin() + n, 0.0f);
        const ptrdiff_t pixel = ptrdiff_t(row) * im.width + first;
        float* __restrict w = weight_.data();
        if (!im.weight) {
            std::fill(w + begin, w + end, im.scale);
        } else if (im.weight_channels == channels_) {
            for (int i = begin; i < end; ++i) w[i] = im.scale * im.weight[pixel * channels_ + i];
        } else {
            for (int p = begin / channels_; p < end / channels_; ++p)
                std::fill_n(w + p * channels_, channels_, im.scale * im.weight[pixel + p]);
        }
    }

    // SSIM of kBlock rows from ring index k on, and its partial derivatives by the four means into their ring.
    double similarity(const Images& im, int k) {
        const int first = c0_ - halo_, n = (c1_ - c0_ + 2 * halo_) * channels_;
        input_.run(k, n, channels_);
        double sum = 0;
        for (int r = 0; r < kBlock; ++r) {
            const int row = r0_ - halo_ + k + r;
            if (row < im.border || row >= im.height - im.border || row >= r1_ + halo_) {
                for (int p = 0; p < partials_; ++p) std::fill_n(partial_.row(p, k + r), n, 0.0f);
                continue;
            }
            load_weights(im, row, first, n);
            if (partials_ == 0) evaluate<0>(k, r, n);
            else if (partials_ == 3) evaluate<3>(k, r, n);
            else evaluate<4>(k, r, n);
            if (row >= r0_ && row < r1_) sum += collect(im, row);
        }
        return sum;
    }

    // SSIM of one row; where gradients are wanted, half its derivatives by mu_x, E(x^2 + y^2), E(d^2) and, for both images,
    // mu_y, times the weights.
    template <int partials>
    void evaluate(int k, int r, int n) {
        const float *mx = input_.blurred(0, r), *my = input_.blurred(1, r), *w = weight_.data();
        const float *squares = input_.blurred(2, r), *difference = input_.blurred(3, r);
        float* by_x = partials ? partial_.row(0, k + r) : nullptr;
        float* by_squares = partials ? partial_.row(1, k + r) : nullptr;
        float* by_difference = partials ? partial_.row(2, k + r) : nullptr;
        float *by_y = partials == 4 ? partial_.row(3, k + r) : nullptr, *value = value_.data();
        const int count = whole_vectors(n);
#pragma GCC ivdep
        for (int i = 0; i < count; ++i) {
            const float x = mx[i], y = my[i], d = x - y, u = x - kShift, v = y - kShift;
            const float var_d = std::max(difference[i] - d * d, 0.0f);
            const float var = std::max(squares[i] - u * u - v * v, 0.0f);
            const float A = x * x + y * y + kC1, B = var + kC2, inverse = 1.0f / (A * B);
            const float a = d * B * inverse, b = A * inverse;
            const float luminance = 1 - d * a, contrast = 1 - var_d * b;
            value[i] = luminance * contrast;
            if constexpr (partials > 0) {
                const float q = w[i] * luminance * b, p = q * var_d * b, g = w[i] * contrast * a;
                by_x[i] = g * (a * x - 1) + q * d - p * u;
                by_squares[i] = 0.5f * p;
                by_difference[i] = -0.5f * q;
                if constexpr (partials == 4) by_y[i] = g * (a * y + 1) - q * d - p * v;
            }
        }
    }

    // The map of one row of the tile itself, and its weighted sum.
    double collect(const Images& im, int row) {
        const int skip = halo_ * channels_, n = (c1_ - c0_) * channels_;
        const float *value = value_.data() + skip, *w = weight_.data() + skip;
        if (im.map) std::copy_n(value, n, im.map + (size_t(row) * im.width + size_t(c0_)) * size_t(channels_));
        float sum = 0;
        for (int i = 0; i < n; ++i) sum += w[i] * value[i];
        return double(sum);
    }

    // Gradient of kBlock rows, from ring index k of the partials on.
    void gradient(const Images& im, int k) {
        const int n = (c1_ - c0_) * channels_;
        if (r0_ + k >= r1_) return;
        partial_.run(k, n, channels_);
        for (int r = 0; r < kBlock && r0_ + k + r < r1_; ++r) {
            const size_t offset = (size_t(r0_ + k + r) * im.width + size_t(c0_)) * size_t(channels_);
            const float *x = im.x + offset, *y = im.y + offset;
            const float *by_x = partial_.blurred(0, r), *by_squares = partial_.blurred(1, r);
            const float *by_difference = partial_.blurred(2, r), *by_y = partials_ == 4 ? partial_.blurred(3, r) : nullptr;
            float *grad_x = im.grad_x + offset, *grad_y = im.grad_y ? im.grad_y + offset : nullptr;
#pragma GCC ivdep
            for (int i = 0; i < n; ++i) {
                const float d = (x[i] - y[i]) * by_difference[i];
                grad_x[i] = 2 * (by_x[i] + 2 * ((x[i] - kShift) * by_squares[i] + d));
                if (grad_y) grad_y[i] = 2 * (by_y[i] + 2 * ((y[i] - kShift) * by_squares[i] - d));
            }
        }
    }

    int channels_, halo_, partials_;
    Blur input_, partial_;
    std::vector<float> weight_, value_;
    int r0_ = 0, r1_ = 0, c0_ = 0, c1_ = 0;
};

}  // namespace

// `batch` pairs of images (H,W,C). `sum` receives the sum over all of scale * weight * SSIM, grad_x and grad_y its
// gradient, `map` SSIM itself. weight_batch: 1 when each image of the batch has its own weights. grad_y needs grad_x too.
SMPLXPP_EXPORT int32_t smplxpp_ssim(
    const float* x, const float* y, const float* weight, int weight_channels, int weight_batch, float scale,
    int batch, int height, int width, int channels, int border,
    double* sum, float* map, float* grad_x, float* grad_y, int threads) { return smplxpp::guarded([&] {
    // Tiles of nearly equal size.
    const int across = std::max(1, int(ptrdiff_t(width) * channels / kTileFloats)), down = (height + kTileRows - 1) / kTileRows;
    const int columns = (width + across - 1) / across, rows = (height + down - 1) / down;
    const ptrdiff_t pixels = ptrdiff_t(height) * width;
    std::vector<double> sums(size_t(batch) * size_t(across) * size_t(down));
    smplxpp::run_threads(threads, [&](int thread) {
        Tile tile(channels, columns, grad_x != nullptr, grad_y != nullptr);
        for (size_t k = size_t(thread); k < sums.size(); k += size_t(threads)) {
            const ptrdiff_t image = ptrdiff_t(k) / (across * down), offset = image * pixels * channels;
            const Images images{
                x + offset, y + offset, weight ? weight + weight_batch * image * pixels * weight_channels : nullptr,
                map ? map + offset : nullptr, grad_x ? grad_x + offset : nullptr, grad_y ? grad_y + offset : nullptr,
                height, width, channels, weight_channels, border, scale};
            const int r0 = int(ptrdiff_t(k) / across % down) * rows, c0 = int(ptrdiff_t(k) % across) * columns;
            sums[k] = tile.run(images, r0, std::min(height, r0 + rows), c0, std::min(width, c0 + columns));
        }
    });
    *sum = 0;
    for (double s : sums) *sum += s;
}); }
