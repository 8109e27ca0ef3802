// The student's field at its control points: an MLP whose first layer is linear in point and pose, so that the point's part
// is known beforehand. Sixteen points at a time, a lane each; weights are broadcast.
#include <algorithm>
#include <vector>

#include "common/parallel.hpp"
#include "common/simd.hpp"
#include "common/status.hpp"

namespace {

using namespace smplxpp;

constexpr int MOST_WIDTH = 512;
constexpr int OUTPUTS = NATIVE == 16 ? 8 : NATIVE == 8 ? 4 : 2;  // sums that registers hold

// Mirrored by avatar/runtime/kernels.py.
struct Network {
    int64_t points, width, layers, inputs;
    const float* of_point;                  // (blocks of 16 points, width, 16)
    const float *of_frame, *frame_bias;     // (width, inputs) (width)
    const float *hidden, *hidden_bias;      // (layers, width, width) (layers, width)
    const float *last, *last_bias;          // (3, width) (3)
};

// out_o = bias_o + sum_i weight_oi x_i for N outputs.
template <int N>
SMPLXPP_INLINE void sums(const float* weight, const float* bias, const float* x, int64_t width, Floats* out) {
    for (int k = 0; k < N; ++k) out[k] = broadcast(bias[k]);
    for (int64_t i = 0; i < width; ++i) {
        const Floats in = load(x + LANES * i);
        for (int k = 0; k < N; ++k) out[k] = fma(broadcast(weight[k * width + i]), in, out[k]);
    }
}

template <int N>
SMPLXPP_INLINE void layer(const float* weight, const float* bias, const float* x, int64_t width, int64_t o, float* out) {
    Floats sum[N];
    sums<N>(weight + o * width, bias + o, x, width, sum);
    for (int k = 0; k < N; ++k) store(out + LANES * (o + k), max(sum[k], zeros()));
}

}  // namespace

// Displacements of a network's points, metres. frames (S, inputs): what points of each set see of pose and code; member
// (points): their set. at (points): rows of `out` (rows, 3) that are added to; null: rows are the points, and written.
SMPLXPP_EXPORT int32_t smplxpp_runtime_field(const Network* net, int64_t S, const float* frames, const int32_t* member,
                                             const int32_t* at, int64_t rows, float* out, int32_t threads) {
    return guarded([&] {
        const int64_t width = net->width, blocks = (net->points + LANES - 1) / LANES;
        if (width > MOST_WIDTH) throw_over_limit();
        check_indices(member, net->points, S);
        if (at) check_indices(at, net->points, rows);
        else if (rows < net->points) throw_out_of_range("rows");
        std::vector<float> of_frame(S * width);
        for (int64_t s = 0; s < S; ++s)
            for (int64_t o = 0; o < width; ++o) {
                float sum = net->frame_bias[o];
                for (int64_t i = 0; i < net->inputs; ++i) sum += net->of_frame[o * net->inputs + i] * frames[s * net->inputs + i];
                of_frame[s * width + o] = sum;
            }
        run_threads(threads, [&](int t) {
            alignas(64) float memory[2][LANES * MOST_WIDTH];
            for (int64_t b = blocks * t / threads, end = blocks * (t + 1) / threads; b < end; ++b) {
                float *x = memory[0], *y = memory[1];
                const int64_t first = b * LANES, count = std::min<int64_t>(LANES, net->points - first);
                for (int l = 0; l < LANES; ++l) {
                    const float* row = of_frame.data() + member[first + std::min<int64_t>(l, count - 1)] * width;
                    for (int64_t o = 0; o < width; ++o) y[LANES * o + l] = row[o];
                }
                const float* own = net->of_point + first * width;
                for (int64_t o = 0; o < width; ++o) store(x + LANES * o, max(load(own + LANES * o) + load(y + LANES * o), zeros()));
                for (int64_t k = 0; k < net->layers; ++k) {
                    const float *weight = net->hidden + k * width * width, *bias = net->hidden_bias + k * width;
                    int64_t o = 0;
                    for (; o + OUTPUTS <= width; o += OUTPUTS) layer<OUTPUTS>(weight, bias, x, width, o, y);
                    for (; o < width; ++o) layer<1>(weight, bias, x, width, o, y);
                    std::swap(x, y);
                }
                Floats moved[3];
                sums<3>(net->last, net->last_bias, x, width, moved);
                alignas(64) float lanes[3][LANES];
                for (int k = 0; k < 3; ++k) store(lanes[k], moved[k]);
                for (int64_t l = 0; l < count; ++l) {
                    float* to = out + 3 * (at ? (int64_t)at[first + l] : first + l);
                    for (int k = 0; k < 3; ++k) to[k] = (at ? to[k] : 0.0f) + lanes[k][l];
                }
            }
        });
    });
}
