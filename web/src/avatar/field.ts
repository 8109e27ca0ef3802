/** How the mesh leaves the T-pose: displacements at control points (`avatar/runtime/field.py`). */

import type { Block, Native } from "../native/memory.ts";
import type { Field, FieldNetwork } from "./avatar.ts";

/** Points that the kernel takes at a time. */
const LANES = 16;

/** The field of an avatar, evaluated by `smplxpp/native/runtime/field.cpp`. */
export class FieldEvaluator {
  /** (C, 3) of the last pose, metres along the axes of the T-pose. */
  readonly moved: Block<Float32Array>;
  private readonly networks: { network: Block<Uint8Array>; member: Block<Int32Array>; at: Block<Int32Array> | null }[];
  private readonly frames: Block<Float32Array>;
  private readonly sets: number;

  constructor(private readonly native: Native, private readonly field: Field) {
    const count = field.setOf.length, inputs = field.body.ofFrame.inputs;
    this.moved = native.floats(3 * count);
    this.sets = (3 * field.sets.length) / (inputs - field.code.length);
    this.frames = native.floats(this.sets * inputs);
    const { view } = this.frames;
    for (let s = 0; s < this.sets; ++s) view.set(field.code, (s + 1) * inputs - field.code.length);
    this.networks = [
      { network: this.network(field.body, null), member: native.keep(field.setOf), at: null },
      {
        network: this.network(field.cloth, field.clothPoints),
        member: native.keep(field.clothPoints.map((point) => field.setOf[point])),
        at: native.keep(field.clothPoints),
      },
    ];
  }

  /** Evaluates the field in a pose `theta` of 63 numbers. */
  evaluate(theta: Float32Array): void {
    const { native, field, moved, sets } = this;
    const { view } = this.frames, inputs = view.length / sets, joints = field.sets.length / sets;
    for (let s = 0; s < sets; ++s) {
      for (let i = 0; i < theta.length; ++i) view[s * inputs + i] = theta[i] * field.sets[s * joints + Math.floor(i / 3)];
    }
    for (const { network, member, at } of this.networks) {
      if (!member.count) continue;
      native.run("runtime_field", network, BigInt(sets), this.frames, member, at, BigInt(moved.count / 3), moved, native.slices);
    }
  }

  private network(own: FieldNetwork, points: Int32Array | null): Block<Uint8Array> {
    const { native } = this, width = own.ofFrame.outputs;
    const count = points ? points.length : own.ofPoint.length / width;
    const lanes = new Float32Array(Math.ceil(count / LANES) * LANES * width);
    for (let p = 0; p < count; ++p) {
      const from = (points ? points[p] : p) * width, to = Math.floor(p / LANES) * LANES * width + (p % LANES);
      for (let o = 0; o < width; ++o) lanes[to + LANES * o] = own.ofPoint[from + o];
    }
    const joined = (part: "weight" | "bias", size: number) => {
      const out = new Float32Array(own.hidden.length * size);
      own.hidden.forEach((layer, k) => out.set(layer[part], k * size));
      return native.keep(out);
    };
    return native.struct([count, width, own.hidden.length, own.ofFrame.inputs], [
      native.keep(lanes), native.keep(own.ofFrame.weight), native.keep(own.ofFrame.bias),
      joined("weight", width * width), joined("bias", width), native.keep(own.last.weight), native.keep(own.last.bias),
    ]);
  }
}
