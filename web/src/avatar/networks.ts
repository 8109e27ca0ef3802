/** Small MLPs on arrays. */

import type { Field, FieldNetwork, Layer } from "./avatar.ts";

/** `out[to..] = W in[at..] + b`, with what is below zero cut off where `relu`. */
function apply(layer: Layer, input: Float32Array, at: number, out: Float32Array, to: number, relu: boolean): void {
  const { inputs, outputs, weight, bias } = layer;
  for (let o = 0; o < outputs; ++o) {
    let a = bias[o], b = 0, c = 0, d = 0;
    let row = o * inputs, i = at;
    // Four sums: one would wait for itself.
    for (const end = at + inputs - 3; i < end; i += 4, row += 4) {
      a += weight[row] * input[i];
      b += weight[row + 1] * input[i + 1];
      c += weight[row + 2] * input[i + 2];
      d += weight[row + 3] * input[i + 3];
    }
    for (; i < at + inputs; ++i, ++row) a += weight[row] * input[i];
    const sum = a + b + c + d;
    out[to + o] = relu && sum < 0 ? 0 : sum;
  }
}

/** What layers, all but the last with ReLU, make of one row. */
export function evaluate(layers: Layer[], input: Float32Array): Float32Array {
  let values = input;
  layers.forEach((layer, k) => {
    const next = new Float32Array(layer.outputs);
    apply(layer, values, 0, next, 0, k + 1 < layers.length);
    values = next;
  });
  return values;
}

/** The deformation field: displacements of the vertices in the T-pose. */
export class FieldEvaluator {
  private readonly points: Float32Array;
  private readonly scratch: [Float32Array, Float32Array];

  constructor(private readonly field: Field) {
    this.points = new Float32Array(3 * field.setOf.length);
    const width = field.body.last.inputs;
    this.scratch = [new Float32Array(width), new Float32Array(width)];
  }

  /** Writes (V, 3) metres along the axes of the T-pose for a pose `theta` of 63 numbers. */
  displacements(theta: Float32Array, out: Float32Array): void {
    const { field, points } = this;
    points.fill(0);
    this.add(field.body, null, theta);
    this.add(field.cloth, field.clothPoints, theta);
    const n = field.neighbourCount;
    for (let v = 0; v < out.length / 3; ++v) {
      let x = 0, y = 0, z = 0;
      for (let k = v * n; k < (v + 1) * n; ++k) {
        const weight = field.weights[k], at = 3 * field.neighbours[k];
        x += weight * points[at];
        y += weight * points[at + 1];
        z += weight * points[at + 2];
      }
      out[3 * v] = x;
      out[3 * v + 1] = y;
      out[3 * v + 2] = z;
    }
  }

  private add(network: FieldNetwork, where: Int32Array | null, theta: Float32Array): void {
    const { field, points } = this;
    const width = network.ofFrame.outputs;
    const ofSet = this.ofSets(network, theta);
    const moved = new Float32Array(3);
    const count = where ? where.length : field.setOf.length;
    for (let i = 0; i < count; ++i) {
      const point = where ? where[i] : i;
      let [x, next] = this.scratch;
      const frame = field.setOf[point] * width;
      for (let o = 0; o < width; ++o) x[o] = Math.max(0, network.ofPoint[point * width + o] + ofSet[frame + o]);
      for (const layer of network.hidden) {
        apply(layer, x, 0, next, 0, true);
        [x, next] = [next, x];
      }
      apply(network.last, x, 0, moved, 0, false);
      points[3 * point] += moved[0];
      points[3 * point + 1] += moved[1];
      points[3 * point + 2] += moved[2];
    }
  }

  /** What pose and code bring to the first layer, for every set of joints that points see. */
  private ofSets(network: FieldNetwork, theta: Float32Array): Float32Array {
    const { sets, code } = this.field;
    const joints = theta.length / 3, count = sets.length / joints, width = network.ofFrame.outputs;
    const input = new Float32Array(theta.length + code.length), out = new Float32Array(count * width);
    input.set(code, theta.length);
    for (let s = 0; s < count; ++s) {
      for (let i = 0; i < theta.length; ++i) input[i] = theta[i] * sets[s * joints + Math.floor(i / 3)];
      apply(network.ofFrame, input, 0, out, s * width, false);
    }
    return out;
  }
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
    apply(layer, encoding, 0, out, p * width, false);
  }
  return out;
}
