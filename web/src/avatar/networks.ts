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

/** Points that go through the layers together: a weight is read once for all of them. */
const TOGETHER = 4;

/** A layer over `TOGETHER` inputs side by side, (inputs, 4) to (outputs, 4), with ReLU; doubles need no conversion. */
function applyTogether(layer: WideLayer, x: Float64Array, out: Float64Array): void {
  const { inputs, outputs, weight, bias } = layer;
  // Two outputs at a time: more sums than these do not stay in registers.
  for (let o = 0; o < outputs; o += 2) {
    let a0 = bias[o], a1 = a0, a2 = a0, a3 = a0;
    let b0 = bias[o + 1], b1 = b0, b2 = b0, b3 = b0;
    let k = o * inputs;
    for (let i = 0; i < 4 * inputs; i += 4, ++k) {
      const a = weight[k], b = weight[k + inputs], x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];
      a0 += a * x0, a1 += a * x1, a2 += a * x2, a3 += a * x3;
      b0 += b * x0, b1 += b * x1, b2 += b * x2, b3 += b * x3;
    }
    const to = 4 * o;
    out[to] = a0 > 0 ? a0 : 0, out[to + 1] = a1 > 0 ? a1 : 0, out[to + 2] = a2 > 0 ? a2 : 0, out[to + 3] = a3 > 0 ? a3 : 0;
    out[to + 4] = b0 > 0 ? b0 : 0, out[to + 5] = b1 > 0 ? b1 : 0, out[to + 6] = b2 > 0 ? b2 : 0, out[to + 7] = b3 > 0 ? b3 : 0;
  }
}

/** A layer in doubles, its outputs filled up to an even number. */
interface WideLayer {
  inputs: number;
  outputs: number;
  weight: Float64Array;
  bias: Float64Array;
}

function widened({ inputs, outputs, weight, bias }: Layer): WideLayer {
  const even = outputs + (outputs % 2);
  const wide = { inputs, outputs: even, weight: new Float64Array(even * inputs), bias: new Float64Array(even) };
  wide.weight.set(weight);
  wide.bias.set(bias);
  return wide;
}

interface WideNetwork {
  network: FieldNetwork;
  hidden: WideLayer[];
  /** Points that it is evaluated at. */
  where: Int32Array;
}

/** The deformation field: displacements of the vertices in the T-pose. */
export class FieldEvaluator {
  private readonly points: Float32Array;
  private readonly networks: WideNetwork[];
  private readonly scratch: [Float64Array, Float64Array];

  constructor(private readonly field: Field) {
    const count = field.setOf.length;
    this.points = new Float32Array(3 * count);
    const wide = (network: FieldNetwork, where: Int32Array) => ({ network, hidden: network.hidden.map(widened), where });
    this.networks = [
      wide(field.body, Int32Array.from({ length: count }, (_, point) => point)),
      wide(field.cloth, field.clothPoints),
    ];
    // One more than the width: an odd one is filled up.
    const width = TOGETHER * (field.body.last.inputs + 1);
    this.scratch = [new Float64Array(width), new Float64Array(width)];
  }

  /** Writes (V, 3) metres along the axes of the T-pose for a pose `theta` of 63 numbers. */
  displacements(theta: Float32Array, out: Float32Array): void {
    const { field, points } = this;
    points.fill(0);
    for (const network of this.networks) this.add(network, theta);
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

  private add({ network, hidden, where }: WideNetwork, theta: Float32Array): void {
    const { field, points } = this, { ofPoint, last } = network;
    const width = network.ofFrame.outputs, ofSet = this.ofSets(network, theta);
    for (let first = 0; first < where.length; first += TOGETHER) {
      let [x, next] = this.scratch;
      const count = Math.min(TOGETHER, where.length - first);
      for (let p = 0; p < TOGETHER; ++p) {
        const point = where[first + Math.min(p, count - 1)], frame = field.setOf[point] * width;
        for (let o = 0; o < width; ++o) x[4 * o + p] = Math.max(0, ofPoint[point * width + o] + ofSet[frame + o]);
      }
      for (const layer of hidden) {
        applyTogether(layer, x, next);
        [x, next] = [next, x];
      }
      for (let p = 0; p < count; ++p) {
        for (let c = 0; c < 3; ++c) {
          let sum = last.bias[c];
          for (let i = 0; i < width; ++i) sum += last.weight[c * width + i] * x[4 * i + p];
          points[3 * where[first + p] + c] += sum;
        }
      }
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
