/** The control points of new poses, linear in the pose (`avatar/models/networks/pose_regression.py`). */

import type { Block, Native } from "../native/memory.ts";
import type { Regression } from "./avatar.ts";

/** The regression of an avatar, its large product by `smplxpp/native/runtime/pose.cpp`. */
export class RegressionEvaluator {
  /** (C, 3) of the last pose, metres along the axes of the T-pose. */
  readonly moved: Block<Float32Array>;
  private readonly basis: Block<Float32Array>;
  private readonly points: Block<Int32Array>;
  private readonly coefficients: Block<Float32Array>;

  constructor(private readonly native: Native, private readonly regression: Regression) {
    const { level, basis, size } = regression;
    this.moved = native.keep(level);
    this.basis = native.keep(basis);
    this.points = native.keep(Int32Array.from({ length: level.length / 3 }, (_, point) => point));
    this.coefficients = native.floats(size);
  }

  /** Evaluates it in a pose `theta` of 63 numbers. */
  evaluate(theta: Float32Array): void {
    const { native, moved, points, coefficients, regression: { level, rows, center, low, high, size } } = this;
    const { view } = coefficients, width = theta.length;
    const turned = theta.map((angle, i) => Math.min(Math.max(angle, low[i]), high[i]) - center[i]);
    for (let d = 0; d < size; ++d) {
      let sum = 0;
      for (let i = 0; i < width; ++i) sum += rows[d * width + i] * turned[i];
      view[d] = sum;
    }
    moved.view.set(level);
    native.run("runtime_basis", BigInt(points.count), BigInt(size), BigInt(points.count), points, this.basis, coefficients, moved);
  }
}
