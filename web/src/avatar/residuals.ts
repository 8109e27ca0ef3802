/** Blend shapes of the Gaussians: what the mesh's motion leaves over in position and colour. */

import type { Avatar, BlendShapes, BlendSide, KnownPoses, Pose } from "./avatar.ts";
import { evaluate } from "./networks.ts";

const JAW = 22;

/** Adds up to (6, N): metres in the triangle's frame, then colour. */
export class Residuals {
  readonly values: Float32Array;
  private readonly shapes: BlendShapes | null;
  private readonly known: KnownPoses | null;

  constructor(avatar: Avatar) {
    this.shapes = avatar.blendShapes;
    this.known = avatar.known;
    this.values = new Float32Array(6 * (this.shapes ? avatar.gaussians.count : 0));
  }

  /** Evaluates the shapes in a pose. */
  pose(pose: Pose, theta: Float32Array): void {
    if (!this.shapes) return;
    this.values.fill(0);
    const { head, body, jaw } = this.shapes;
    const ofHead = new Float32Array(head.layers[0].inputs);
    const expressions = ofHead.length - (jaw ? 3 : 0);
    ofHead.set(pose.expression.subarray(0, expressions));
    if (jaw) ofHead.set(pose.rotations.subarray(3 * JAW, 3 * JAW + 3), expressions);
    this.add(head, evaluate(head.layers, ofHead), 1);
    const share = this.known ? knownShare(this.known, theta) : 1;
    // A share this small moves nothing that shows: a pose far from all known ones costs nothing.
    if (share > 1e-4) this.add(body, evaluate(body.layers, theta), share);
  }

  private add(side: BlendSide, coefficients: Float32Array, share: number): void {
    const { rows, values, step, exponent, shapes } = side;
    const out = this.values, part = this.shapes!.part;
    const count = out.length / 6, used = shapes ? values.length / (6 * shapes) : 0;
    const sum = new Float32Array(used);
    for (let c = 0; c < 6; ++c) {
      sum.fill(0);
      const unit = (k: number) => share * (step ? step[6 * k + c] : 1);
      if (part) {
        for (let k = 0; k < shapes; ++k) {
          const at = (6 * k + c) * used, factor = unit(k);
          for (let m = 0; m < used; ++m) {
            sum[m] += values[at + m] * factor * coefficients[part[rows ? rows[m] : m] * shapes + k];
          }
        }
      } else {
        // Four shapes at a time: the sum is read and written once for them. Past the last one the factor is 0.
        const factor = (k: number) => (k < shapes ? unit(k) * coefficients[k] : 0);
        const start = (k: number) => (6 * Math.min(k, shapes - 1) + c) * used;
        for (let k = 0; k < shapes; k += 4) {
          const [f0, f1, f2, f3] = [factor(k), factor(k + 1), factor(k + 2), factor(k + 3)];
          const [a0, a1, a2, a3] = [start(k), start(k + 1), start(k + 2), start(k + 3)];
          for (let m = 0; m < used; ++m) {
            sum[m] += f0 * values[a0 + m] + f1 * values[a1 + m] + f2 * values[a2 + m] + f3 * values[a3 + m];
          }
        }
      }
      for (let m = 0; m < used; ++m) {
        out[c * count + (rows ? rows[m] : m)] += exponent ? sum[m] * 2 ** exponent[m] : sum[m];
      }
    }
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
