/** The network from sound to the mouth: `avatar.speech.lips`, row by row. */

import { BundleError } from "../bundle/errors.ts";
import type { Piece, Tensor } from "../bundle/tensors.ts";
import { BANDS } from "./features.ts";

const VERSION = 1, PHONES = 40;
/** Jaw hanging, lips pressed together, lower lip under the teeth, lips rounded, spread, teeth bared. */
export const ARTICULATORS = 6;
const AGAIN = "write the page anew";

interface Layer {
  /** By place in time, then output, then input. */
  weights: Float32Array;
  bias: Float32Array;
  inputs: number;
  outputs: number;
  width: number;
  /** Rows from one place in time to the next. */
  reach: number;
  /** What came in last, a ring of rows. */
  past: Float32Array;
}

export class LipNetwork {
  /** Seconds before a row's last sample that it tells of. */
  readonly delay: number;
  private readonly layers: Layer[];
  private row = 0;

  /** @throws BundleError another network than this version's. */
  constructor({ tensors, about }: Piece) {
    const { version, delay, dilations } = (about ?? {}) as { version?: number; delay?: number; dilations?: number[] };
    if (version !== VERSION || typeof delay !== "number" || !Array.isArray(dilations)) {
      throw new BundleError("lip network", `version ${VERSION}`, String(version), AGAIN);
    }
    this.delay = delay;
    const names = ["first", ...dilations.map((_, k) => `middle${k}`), "last"];
    this.layers = names.map((name, k) => layerOf(name, tensors, k && k <= dilations.length ? dilations[k - 1] : 1));
    let width = BANDS;
    for (const { inputs, outputs } of this.layers) {
      if (inputs !== width) throw new BundleError("lip network", `${width} inputs`, String(inputs), AGAIN);
      width = outputs;
    }
    if (width !== PHONES + ARTICULATORS) throw new BundleError("lip network", `${PHONES + ARTICULATORS} outputs`, String(width), AGAIN);
  }

  /** Probabilities of phonemes and the `ARTICULATORS`, 0 to 1, of the next row that is heard. */
  push(heard: Float32Array): { phones: Float32Array; mouth: Float32Array } {
    let h = heard;
    this.layers.forEach((layer, k) => {
      const out = step(layer, h, this.row), last = k === this.layers.length - 1;
      if (!last) for (let i = 0; i < out.length; ++i) out[i] = Math.max(k ? h[i] + out[i] : out[i], 0);
      h = out;
    });
    ++this.row;
    const logits = h.subarray(0, PHONES), most = Math.max(...logits), grown = logits.map((value) => Math.exp(value - most));
    const sum = grown.reduce((total, value) => total + value, 0);
    return { phones: grown.map((value) => value / sum), mouth: h.slice(PHONES).map((value) => 1 / (1 + Math.exp(-value))) };
  }
}

function layerOf(name: string, tensors: Map<string, Tensor>, reach: number): Layer {
  const [weight, scale, bias] = ["weight", "scale", "bias"].map((part) => tensors.get(`${name}.${part}`));
  const [outputs, inputs, width] = weight?.shape ?? [];
  if (!weight || weight.shape.length !== 3 || scale?.values.length !== outputs || bias?.values.length !== outputs) {
    throw new BundleError(`lip network: ${name}`, "weights, scales and biases", "others", AGAIN);
  }
  const weights = new Float32Array(weight.values.length);
  for (let o = 0; o < outputs; ++o) {
    for (let i = 0; i < inputs; ++i) {
      for (let k = 0; k < width; ++k) {
        weights[(k * outputs + o) * inputs + i] = Number(weight.values[(o * inputs + i) * width + k]) * Number(scale.values[o]);
      }
    }
  }
  const past = new Float32Array(((width - 1) * reach + 1) * inputs);
  return { weights, bias: Float32Array.from(bias.values as Float32Array), inputs, outputs, width, reach, past };
}

/** One row of a convolution that sees the past alone, zeros before the start. */
function step({ weights, bias, inputs, outputs, width, reach, past }: Layer, heard: Float32Array, row: number): Float32Array {
  const rows = past.length / inputs, out = bias.slice();
  past.set(heard, (row % rows) * inputs);
  for (let k = 0; k < width; ++k) {
    const from = ((row + rows - (width - 1 - k) * reach) % rows) * inputs;
    for (let o = 0, w = k * outputs * inputs; o < outputs; ++o) {
      let sum = 0;
      for (let i = 0; i < inputs; ++i) sum += weights[w++] * past[from + i];
      out[o] += sum;
    }
  }
  return out;
}
