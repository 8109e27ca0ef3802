/** Blend shapes of the Gaussians: what the mesh's motion leaves over in position and colour (`avatar/runtime/blend.py`). */

import type { Block, Native } from "../native/memory.ts";
import type { BlendShapes, BlendSide, KnownPoses, Pose } from "./avatar.ts";
import { evaluate } from "./networks.ts";

const JAW = 22, LANES = 16, NUMBERS = 6;
/** Share of a pose that training saw below which its blend shapes move nothing that shows. */
const LEAST_SHARE = 1e-4;

interface Side {
  side: BlendSide;
  shapes: Block<Uint8Array>;
  scaled: Block<Float32Array>;
}

/** Adds up (N, 6): metres in the triangle's frame, then colour. */
export class BlendAdder {
  readonly added: Block<Float32Array>;
  private readonly head: Side;
  private readonly body: Side;

  constructor(
    private readonly native: Native, private readonly shapes: BlendShapes, private readonly known: KnownPoses | null, private readonly count: number,
  ) {
    this.added = native.floats(NUMBERS * count);
    [this.head, this.body] = [this.side(shapes.head), this.side(shapes.body)];
  }

  /**
   * Evaluates the shapes in a pose.
   *
   * @param keep (N,) what part of the body's shapes each Gaussian takes; null: all of them.
   */
  pose(pose: Pose, theta: Float32Array, keep: Block<Float32Array> | null): void {
    const { head, body, known, shapes: { jaw } } = this;
    this.added.view.fill(0);
    const ofHead = new Float32Array(head.side.layers[0].inputs);
    const expressions = ofHead.length - (jaw ? 3 : 0);
    ofHead.set(pose.expression.subarray(0, expressions));
    if (jaw) ofHead.set(pose.rotations.subarray(3 * JAW, 3 * JAW + 3), expressions);
    this.add(head, ofHead, 1, null);
    const share = known ? knownShare(known, theta) : 1;
    if (share > LEAST_SHARE) this.add(body, theta, share, keep);
  }

  private add({ side, shapes, scaled }: Side, inputs: Float32Array, share: number, keep: Block<Float32Array> | null): void {
    if (!scaled.count) return;
    const coefficients = evaluate(side.layers, inputs), { view } = scaled, { step } = side;
    for (let k = 0; k * NUMBERS < view.length; ++k) {
      for (let c = 0; c < NUMBERS; ++c) {
        view[NUMBERS * k + c] = share * coefficients[k] * (step ? step[NUMBERS * (k % side.shapes) + c] : 1);
      }
    }
    this.native.run("runtime_blend", shapes, scaled, keep, this.added, this.native.slices);
  }

  private side(side: BlendSide): Side {
    const { native, shapes: { part } } = this, { rows, values, exponent, shapes } = side;
    const count = shapes ? values.length / (NUMBERS * shapes) : 0, blocks = Math.ceil(count / LANES);
    const Kind = values.constructor as Float32ArrayConstructor | Int8ArrayConstructor;
    const lanes = new Kind(blocks * LANES * NUMBERS * shapes), scale = new Float32Array(blocks * LANES).fill(1);
    for (let m = 0; m < count; ++m) {
      const block = Math.floor(m / LANES) * LANES * NUMBERS * shapes + (m % LANES);
      for (let k = 0; k < NUMBERS * shapes; ++k) lanes[block + k * LANES] = values[k * count + m];
      if (exponent) scale[m] = 2 ** exponent[m];
    }
    const own = part && (rows ? rows.map((row) => part[row]) : part);
    const parts = own ? own.reduce((most, one) => Math.max(most, one), 0) + 1 : 1;
    const kept = native.keep(lanes), integers = values instanceof Int8Array;
    return {
      side,
      shapes: native.struct([count, shapes, this.count, parts], [
        integers ? kept : null, integers ? null : kept, native.keep(scale), rows && native.keep(rows), own && native.keep(own),
      ]),
      scaled: native.floats(count ? NUMBERS * parts * shapes : 0),
    };
  }
}

/** How much a pose counts as one that training saw: 1 up to the scale from the nearest, then a Gaussian's flank. */
export function knownShare(known: KnownPoses, theta: Float32Array): number {
  let nearest = Infinity;
  for (let at = 0; at < known.poses.length; at += theta.length) {
    let square = 0;
    for (let i = 0; i < theta.length; ++i) square += (known.poses[at + i] - theta[i]) ** 2;
    nearest = Math.min(nearest, square);
  }
  const over = Math.max(0, (Math.sqrt(nearest) - known.scale) / known.scale);
  return Math.exp(-0.5 * over * over);
}
