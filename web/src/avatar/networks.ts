/** Small MLPs on arrays: what is evaluated once an avatar or once a pose. */

import type { Layer } from "./avatar.ts";

/** `out[to..] = W in + b`, with what is below zero cut off where `relu`. */
function apply(layer: Layer, input: Float32Array, out: Float32Array, to: number, relu: boolean): void {
  const { inputs, outputs, weight, bias } = layer;
  for (let o = 0; o < outputs; ++o) {
    let a = bias[o], b = 0, c = 0, d = 0;
    let row = o * inputs, i = 0;
    // Four sums: one would wait for itself.
    for (const end = inputs - 3; i < end; i += 4, row += 4) {
      a += weight[row] * input[i];
      b += weight[row + 1] * input[i + 1];
      c += weight[row + 2] * input[i + 2];
      d += weight[row + 3] * input[i + 3];
    }
    for (; i < inputs; ++i, ++row) a += weight[row] * input[i];
    const sum = a + b + c + d;
    out[to + o] = relu && sum < 0 ? 0 : sum;
  }
}

/** What layers, all but the last with ReLU, make of one row. */
export function evaluate(layers: Layer[], input: Float32Array): Float32Array {
  let values = input;
  layers.forEach((layer, k) => {
    const next = new Float32Array(layer.outputs);
    apply(layer, values, next, 0, k + 1 < layers.length);
    values = next;
  });
  return values;
}

/** `phi(v) = (v, sin(2^l pi v), cos(2^l pi v))` times the weights of the first layer: (K, width), once an avatar. */
export function encodedPoints(points: Float32Array, weight: Float32Array, width: number): Float32Array {
  const inputs = weight.length / width, bands = (inputs - 3) / 6, count = points.length / 3;
  const encoding = new Float32Array(inputs), out = new Float32Array(count * width);
  const layer = { inputs, outputs: width, weight, bias: new Float32Array(width) };
  for (let p = 0; p < count; ++p) {
    for (let c = 0; c < 3; ++c) {
      encoding[c] = points[3 * p + c];
      for (let l = 0; l < bands; ++l) {
        const angle = points[3 * p + c] * Math.PI * 2 ** l;
        encoding[3 + 3 * l + c] = Math.sin(angle);
        encoding[3 + 3 * bands + 3 * l + c] = Math.cos(angle);
      }
    }
    apply(layer, encoding, out, p * width, false);
  }
  return out;
}
