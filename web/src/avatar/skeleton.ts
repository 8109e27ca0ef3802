/** Forward kinematics: where the joints take the points of the rest pose. */

import type { Pose, Skeleton } from "./avatar.ts";
import { matrixFromRotvec } from "../math/rotations.ts";

/** Working memory and results of one pose. */
export class JointTransforms {
  /** (J, 9) of each joint relative to its parent. */
  readonly local: Float64Array;
  /** (J, 12) rows of the affine maps that take a point at rest to the pose. */
  readonly posedFromRest: Float64Array;
  private readonly turned: Float64Array;
  private readonly place: Float64Array;
  private readonly rest: Float64Array;

  constructor(private readonly skeleton: Skeleton) {
    const joints = skeleton.parents.length;
    this.local = new Float64Array(9 * joints);
    this.posedFromRest = new Float64Array(12 * joints);
    this.turned = new Float64Array(9 * joints);
    this.place = new Float64Array(3 * joints);
    this.rest = new Float64Array(3 * joints);
  }

  /** `G_j [I, -J_j; 0, 1]` with `G_j = G_parent [R_j, J_j - J_parent]`; the root turns about its joint and moves last. */
  pose(pose: Pose): void {
    const { parents, byExpression, rest: neutral } = this.skeleton;
    const { local, turned, place, rest, posedFromRest: out } = this;
    const expressions = pose.expression.length;
    for (let i = 0; i < rest.length; ++i) {
      let value = neutral[i];
      for (let e = 0; e < expressions; ++e) value += byExpression[i * expressions + e] * pose.expression[e];
      rest[i] = value;
    }
    for (let j = 0; j < parents.length; ++j) {
      matrixFromRotvec(pose.rotations, 3 * j, local, 9 * j);
      const parent = parents[j];
      if (parent < 0) {
        for (let k = 0; k < 9; ++k) turned[9 * j + k] = local[9 * j + k];
        for (let k = 0; k < 3; ++k) place[3 * j + k] = rest[3 * j + k] + pose.translation[k];
      } else {
        const up = 9 * parent;
        for (let r = 0; r < 3; ++r) {
          let moved = place[3 * parent + r];
          for (let k = 0; k < 3; ++k) moved += turned[up + 3 * r + k] * (rest[3 * j + k] - rest[3 * parent + k]);
          place[3 * j + r] = moved;
          for (let c = 0; c < 3; ++c) {
            let sum = 0;
            for (let k = 0; k < 3; ++k) sum += turned[up + 3 * r + k] * local[9 * j + 3 * k + c];
            turned[9 * j + 3 * r + c] = sum;
          }
        }
      }
      for (let r = 0; r < 3; ++r) {
        let shift = place[3 * j + r];
        for (let k = 0; k < 3; ++k) {
          out[12 * j + 4 * r + k] = turned[9 * j + 3 * r + k];
          shift -= turned[9 * j + 3 * r + k] * rest[3 * j + k];
        }
        out[12 * j + 4 * r + 3] = shift;
      }
    }
  }
}
