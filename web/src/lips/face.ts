/** How the avatar's own face speaks: articulators to expressions and the jaw, `avatar.speech.Face.pose`. */

import type { Pose } from "../avatar/avatar.ts";
import { BundleError } from "../bundle/errors.ts";
import type { Piece } from "../bundle/tensors.ts";
import { ARTICULATORS } from "./network.ts";

const JAW = 0, PRESS = 1;
/** What each articulator asks of ARKit's expressions; radians of an open jaw; the most that an expression is set to: `avatar.speech.face`. */
const ARKIT: Record<string, Record<string, number>> = {
  jaw: { jawOpen: 0.25, mouthLowerDown: 0.15 }, press: { mouthPress: 0.5, mouthRollLower: 0.3, mouthRollUpper: 0.25 },
  tuck: { mouthRollLower: 0.7, mouthUpperUp: 0.2 }, round: { mouthPucker: 0.7, mouthFunnel: 0.35 },
  spread: { mouthSmile: 0.3, mouthStretch: 0.35 }, bare: { mouthLowerDown: 0.3, mouthUpperUp: 0.2 },
};
const JAW_OPEN = 0.6, JAW_ANGLE = 0.15, MOST = 0.8;

export class SpeakingFace {
  private readonly basis: Float64Array;
  private readonly neutral: Float64Array;
  private readonly lowest: Float64Array;
  private readonly highest: Float64Array;
  /** Rotation vector of the jaw at rest; radians that it hangs at 1, and at most. */
  private readonly jaw: Float64Array;
  private readonly hangs: number;
  private readonly reach: number;
  /** Expressions that the mouth moves: the others stay those of the motion. */
  private readonly moved: number[];

  /** @param joint of the jaw; -1: the body has none. @throws BundleError a face of another body. */
  constructor({ tensors }: Piece, expressions: number, private readonly joint: number) {
    const take = (name: string, count: number): Float64Array => {
      const values = tensors.get(`face.${name}`)?.values;
      if (values?.length !== count) throw new BundleError(`the face's ${name}`, `${count} numbers`, `${values?.length ?? "none"}`, "write the page anew");
      return Float64Array.from(values as Float64Array);
    };
    this.basis = take("basis", ARTICULATORS * expressions);
    [this.neutral, this.lowest, this.highest] = ["neutral", "lowest", "highest"].map((name) => take(name, expressions));
    this.jaw = take("jaw", 3);
    [this.hangs, this.reach] = take("jaw_reach", 2);
    this.moved = [...this.neutral.keys()].filter((e) => [...Array(ARTICULATORS).keys()].some((a) => this.basis[a * expressions + e] !== 0));
  }

  /** The face of a body with ARKit's expressions, of which no frame is known; null: it has none of the mouth's. */
  static named(expressionNames: readonly string[], joint: number): SpeakingFace | null {
    const count = expressionNames.length, basis = new Float64Array(ARTICULATORS * count);
    Object.values(ARKIT).forEach((shapes, row) => Object.entries(shapes).forEach(([name, weight]) => {
      // Without a joint the mouth opens by its expression alone.
      const value = name === "jawOpen" && joint < 0 ? JAW_OPEN : weight;
      for (const side of ["", "Left", "Right"]) {
        const at = expressionNames.indexOf(name + side);
        if (at >= 0) basis[row * count + at] = value;
      }
    }));
    if (!basis.some((value) => value)) return null;
    const made = { basis, neutral: new Float64Array(count), lowest: new Float64Array(count), highest: new Float64Array(count).fill(MOST), jaw: new Float64Array(3) };
    const tensors = Object.entries({ ...made, jaw_reach: Float64Array.of(JAW_ANGLE, JAW_ANGLE) });
    return new SpeakingFace({ tensors: new Map(tensors.map(([name, values]) => [`face.${name}`, { dtype: "F64", shape: [values.length], values }])), about: {} }, count, joint);
  }

  /** A pose with the mouth of these articulators, 0 to 1. */
  pose(mouth: ArrayLike<number>, pose: Pose): Pose {
    const expression = pose.expression.slice(), rotations = pose.rotations.slice(), width = this.neutral.length;
    for (const e of this.moved) {
      let asked = this.neutral[e];
      for (let a = 0; a < ARTICULATORS; ++a) asked += mouth[a] * this.basis[a * width + e];
      expression[e] = Math.min(Math.max(asked, this.lowest[e]), this.highest[e]);
    }
    if (this.joint >= 0) {
      rotations.set(this.jaw, 3 * this.joint);
      // A jaw that rests open has to close for bilabials.
      rotations[3 * this.joint] += Math.min(this.hangs * mouth[JAW], this.reach) - mouth[PRESS] * Math.max(this.jaw[0], 0);
    }
    return { ...pose, expression, rotations };
  }
}
