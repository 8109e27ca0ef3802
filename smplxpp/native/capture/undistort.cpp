// Undistortion of 8-bit images: every output pixel looks up the lens model and interpolates; no map is stored.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "common/parallel.hpp"

namespace {

// OpenCV's rational model: k1..k6 radial, p1, p2 tangential.
struct Rational {
    double k[6], p[2];

    explicit Rational(const double* lens) {
        std::memcpy(k, lens, sizeof(k));
        std::memcpy(p, lens + 6, sizeof(p));
    }

    void distort(double x, double y, double& xd, double& yd) const {  // no branch: the row's loop is vectorised
        const double r2 = x * x + y * y;
        const double radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])));
        xd = x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x);
        yd = y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y;
    }
};

// OpenCV's fisheye: k1..k4 of the angle's polynomial, and the distance on the plane beyond which it shows nothing.
struct Fisheye {
    double k[4], reach;

    explicit Fisheye(const double* lens) : reach(lens[4]) { std::memcpy(k, lens, sizeof(k)); }

    void distort(double x, double y, double& xd, double& yd) const {
        const double r = std::sqrt(x * x + y * y), theta = std::atan(r), t2 = theta * theta;
        double scale = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r;
        if (r == 0) scale = 1;
        if (r > reach) scale = std::numeric_limits<double>::quiet_NaN();
        xd = x * scale;
        yd = y * scale;
    }
};

// The field-of-view model: omega, and 2 tan(omega / 2).
struct FieldOfView {
    double omega, slope;

    explicit FieldOfView(const double* lens) : omega(lens[0]), slope(lens[1]) {}

    void distort(double x, double y, double& xd, double& yd) const {
        const double r = std::sqrt(x * x + y * y);
        const double scale = r == 0 ? slope / omega : std::atan(slope * r) / (omega * r);
        xd = x * scale;
        yd = y * scale;
    }
};

struct Image {
    const uint8_t* data;
    int width, height;
};

template <int channels>
void nearest(const Image& source, double u, double v, uint8_t* out) {
    int column = static_cast<int>(u), row = static_cast<int>(v);
    if (column > source.width - 1) column = source.width - 1;
    if (row > source.height - 1) row = source.height - 1;
    std::memcpy(out, source.data + (static_cast<int64_t>(row) * source.width + column) * channels, channels);
}

template <int channels>
void bilinear(const Image& source, double u, double v, uint8_t* out) {
    // Pixel centres are at +0.5; u and v are not negative, so that the cast, which rounds towards zero, is a floor.
    const double x = u + 0.5, y = v + 0.5;
    const int x1 = static_cast<int>(x), y1 = static_cast<int>(y), x0 = x1 - 1, y0 = y1 - 1;
    // Weights of 11 bits: an 8-bit value times two of them fits in 31 bits.
    const int fx = static_cast<int>((x - x1) * 2048 + 0.5), fy = static_cast<int>((y - y1) * 2048 + 0.5);
    const int left = x0 < 0 ? 0 : x0, right = x1 > source.width - 1 ? source.width - 1 : x1;
    const int top = y0 < 0 ? 0 : y0, bottom = y1 > source.height - 1 ? source.height - 1 : y1;
    const uint8_t* upper = source.data + static_cast<int64_t>(top) * source.width * channels;
    const uint8_t* lower = source.data + static_cast<int64_t>(bottom) * source.width * channels;
    const uint8_t *a = upper + left * channels, *b = upper + right * channels;
    const uint8_t *d = lower + left * channels, *e = lower + right * channels;
    for (int c = 0; c < channels; ++c) {
        const int above = a[c] * (2048 - fx) + b[c] * fx, below = d[c] * (2048 - fx) + e[c] * fx;
        out[c] = static_cast<uint8_t>((above * (2048 - fy) + below * fy + (1 << 21)) >> 22);
    }
}

template <class Lens, int channels, void (*sample)(const Image&, double, double, uint8_t*)>
void undistort(const Image& source, const Lens& lens, const double* inverse, const double* K, uint8_t* out, int width,
               int height) {
    std::vector<double> u(width), v(width);
    for (int j = 0; j < height; ++j) {
        const double t = j + 0.5;
        const double row_x = inverse[1] * t + inverse[2], row_y = inverse[4] * t + inverse[5];
        double *us = u.data(), *vs = v.data();
        for (int i = 0; i < width; ++i) {
            double xd, yd;
            lens.distort(inverse[0] * (i + 0.5) + row_x, inverse[3] * (i + 0.5) + row_y, xd, yd);
            us[i] = K[0] * xd + K[1] * yd + K[2];
            vs[i] = K[3] * xd + K[4] * yd + K[5];
        }
        uint8_t* pixel = out + static_cast<int64_t>(j) * width * channels;
        for (int i = 0; i < width; ++i, pixel += channels) {
            if (us[i] >= 0 && vs[i] >= 0 && us[i] <= source.width && vs[i] <= source.height)  // false for NaN too
                sample(source, us[i], vs[i], pixel);
            else
                std::memset(pixel, 0, channels);
        }
    }
}

template <class Lens>
void undistort(const Image& source, int channels, bool use_nearest, const Lens& lens, const double* inverse, const double* K,
               uint8_t* out, int width, int height) {
    const auto work = channels == 1 ? (use_nearest ? undistort<Lens, 1, nearest<1>> : undistort<Lens, 1, bilinear<1>>)
                                    : (use_nearest ? undistort<Lens, 3, nearest<3>> : undistort<Lens, 3, bilinear<3>>);
    work(source, lens, inverse, K, out, width, height);
}

}  // namespace

// Pixels of an undistorted image (height, width, channels) from a distorted one; 0 where it does not reach.
// inverse: 2x3, from output pixels to the plane z = 1; K: 2x3, from the distorted plane to source pixels;
// model and lens: 0, k1..k6, p1, p2 (rational); 1, k1..k4, reach (fisheye); 2, omega, slope (field of view);
// channels 1 or 3.
SMPLXPP_EXPORT int32_t smplxpp_undistort_image(const uint8_t* source, int source_width, int source_height, int channels,
                                               const double* inverse, const double* K, int model, const double* lens,
                                               int use_nearest, uint8_t* out, int width, int height) { return smplxpp::guarded([&] {
    const Image image{source, source_width, source_height};
    if (model == 0)
        undistort(image, channels, use_nearest, Rational(lens), inverse, K, out, width, height);
    else if (model == 1)
        undistort(image, channels, use_nearest, Fisheye(lens), inverse, K, out, width, height);
    else
        undistort(image, channels, use_nearest, FieldOfView(lens), inverse, K, out, width, height);
}); }
