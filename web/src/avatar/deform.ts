/** An avatar in a pose: from joints to Gaussians in the world, as `avatar.models.student` does it. */

import type { Avatar, Pose } from "./avatar.ts";
import { triangleFrames } from "./frames.ts";
import { harmonics } from "./harmonics.ts";
import { FieldEvaluator } from "./networks.ts";
import { Residuals } from "./residuals.ts";
import { JointTransforms } from "./skeleton.ts";

/** Numbers of a Gaussian in the world: centre 3, opacity, covariance 6 (xx xy xz yy yz zz), colour 3, unused. */
export const RECORD = 14;
const BODY_JOINTS = 21;

/** Poses an avatar; holds the working memory. WebAssembly that does the same takes its place here. */
export class Deformer {
  /** (V, 3) of the last pose, metres. */
  readonly vertices: Float32Array;
  /** (N, 3) of the last pose, metres. */
  readonly centers: Float32Array;
  private readonly joints: JointTransforms;
  private readonly field: FieldEvaluator | null;
  private readonly residuals: Residuals;
  private readonly rest: Float32Array;
  private readonly moved: Float32Array;
  private readonly rotations: Float32Array;
  private readonly lengths: Float32Array;

  constructor(readonly avatar: Avatar) {
    const { mesh, skeleton } = avatar;
    this.vertices = new Float32Array(mesh.vertices.length);
    this.rest = new Float32Array(mesh.vertices.length);
    this.moved = new Float32Array(mesh.vertices.length);
    this.rotations = new Float32Array(3 * mesh.faces.length);
    this.lengths = new Float32Array(mesh.faces.length / 3);
    this.centers = new Float32Array(3 * avatar.gaussians.count);
    this.joints = new JointTransforms(skeleton);
    this.field = avatar.field && new FieldEvaluator(avatar.field);
    this.residuals = new Residuals(avatar);
  }

  /** Moves the mesh, its triangles' frames and the Gaussians' residuals to a pose. */
  pose(pose: Pose): void {
    const { mesh } = this.avatar;
    const theta = Float32Array.from(pose.rotations.subarray(3, 3 + 3 * BODY_JOINTS));
    this.joints.pose(pose);
    this.field?.displacements(theta, this.moved);
    this.shape(pose);
    skin(this.rest, mesh.joints, mesh.weights, this.joints.posedFromRest, this.vertices);
    triangleFrames(this.vertices, mesh.faces, this.rotations, this.lengths);
    this.residuals.pose(pose, theta);
    this.place();
  }

  /** `u v1 + v v2 + (1 - u - v) v3 + R (offset + residual)`. */
  private place(): void {
    const { gaussians: g, mesh: { faces } } = this.avatar;
    const { rotations: R, vertices: x, centers } = this;
    const extra = this.residuals.values, N = g.count, moving = extra.length > 0;
    for (let i = 0; i < N; ++i) {
      const face = g.face[i], f = 9 * face;
      const a = 3 * faces[3 * face], b = 3 * faces[3 * face + 1], c = 3 * faces[3 * face + 2];
      const u = g.barycentric[2 * i], v = g.barycentric[2 * i + 1], w = 1 - u - v;
      let n = g.offset[3 * i], q = g.offset[3 * i + 1], s = g.offset[3 * i + 2];
      if (moving) n += extra[i], q += extra[N + i], s += extra[2 * N + i];
      for (let k = 0; k < 3; ++k) {
        const turned = R[f + 3 * k] * n + R[f + 3 * k + 1] * q + R[f + 3 * k + 2] * s;
        centers[3 * i + k] = u * x[a + k] + v * x[b + k] + w * x[c + k] + turned;
      }
    }
  }

  /** The T-pose with expression, pose correctives and the field's displacements. */
  private shape(pose: Pose): void {
    const { vertices, expressions, correctives } = this.avatar.mesh;
    for (let i = 0; i < vertices.length; ++i) this.rest[i] = vertices[i] + this.moved[i];
    addShapes(this.rest, expressions.rows, expressions.basis, Float32Array.from(pose.expression));
    if (correctives) {
      const feature = new Float32Array(correctives.size);
      for (let i = 0; i < feature.length; ++i) feature[i] = this.joints.local[9 + i] - (i % 9 % 4 === 0 ? 1 : 0);
      addShapes(this.rest, correctives.rows, correctives.basis, feature);
    }
  }

  /**
   * Writes the Gaussians of the last pose, in the given order, as a camera at `eye` (metres) sees them.
   *
   * @param order which Gaussians; null: all.
   */
  records(eye: ArrayLike<number>, order: Uint32Array | null, out: Float32Array): void {
    const g = this.avatar.gaussians;
    const { rotations: R, lengths, centers } = this;
    const extra = this.residuals.values, N = g.count, K = g.harmonicCount, moving = extra.length > 0;
    const basis = new Float64Array(Math.max(K, 3));
    const count = order ? order.length : N;
    for (let row = 0, to = 0; row < count; ++row, to += RECORD) {
      const i = order ? order[row] : row;
      const face = g.face[i], f = 9 * face;
      const mx = centers[3 * i], my = centers[3 * i + 1], mz = centers[3 * i + 2];
      out[to] = mx, out[to + 1] = my, out[to + 2] = mz;
      out[to + 3] = g.opacity[i];

      // R C R^T, C in squared edge lengths.
      const c = 6 * i, square = lengths[face] * lengths[face];
      const xx = square * g.covariance[c], xy = square * g.covariance[c + 1], xz = square * g.covariance[c + 2];
      const yy = square * g.covariance[c + 3], yz = square * g.covariance[c + 4], zz = square * g.covariance[c + 5];
      const ax = R[f] * xx + R[f + 1] * xy + R[f + 2] * xz, ay = R[f] * xy + R[f + 1] * yy + R[f + 2] * yz;
      const az = R[f] * xz + R[f + 1] * yz + R[f + 2] * zz;
      const bx = R[f + 3] * xx + R[f + 4] * xy + R[f + 5] * xz, by = R[f + 3] * xy + R[f + 4] * yy + R[f + 5] * yz;
      const bz = R[f + 3] * xz + R[f + 4] * yz + R[f + 5] * zz;
      const cx = R[f + 6] * xx + R[f + 7] * xy + R[f + 8] * xz, cy = R[f + 6] * xy + R[f + 7] * yy + R[f + 8] * yz;
      const cz = R[f + 6] * xz + R[f + 7] * yz + R[f + 8] * zz;
      out[to + 4] = ax * R[f] + ay * R[f + 1] + az * R[f + 2];
      out[to + 5] = ax * R[f + 3] + ay * R[f + 4] + az * R[f + 5];
      out[to + 6] = ax * R[f + 6] + ay * R[f + 7] + az * R[f + 8];
      out[to + 7] = bx * R[f + 3] + by * R[f + 4] + bz * R[f + 5];
      out[to + 8] = bx * R[f + 6] + by * R[f + 7] + bz * R[f + 8];
      out[to + 9] = cx * R[f + 6] + cy * R[f + 7] + cz * R[f + 8];

      let red = g.color[3 * i], green = g.color[3 * i + 1], blue = g.color[3 * i + 2];
      if (moving) red += extra[3 * N + i], green += extra[4 * N + i], blue += extra[5 * N + i];
      if (K) {
        let dx = mx - eye[0], dy = my - eye[1], dz = mz - eye[2];
        const inverse = 1 / Math.sqrt(dx * dx + dy * dy + dz * dz);
        dx *= inverse, dy *= inverse, dz *= inverse;
        const lx = R[f] * dx + R[f + 3] * dy + R[f + 6] * dz;
        const ly = R[f + 1] * dx + R[f + 4] * dy + R[f + 7] * dz;
        const lz = R[f + 2] * dx + R[f + 5] * dy + R[f + 8] * dz;
        harmonics(lx, ly, lz, K, basis);
        for (let k = 0, at = 3 * K * i; k < K; ++k, at += 3) {
          red += basis[k] * g.harmonics[at];
          green += basis[k] * g.harmonics[at + 1];
          blue += basis[k] * g.harmonics[at + 2];
        }
      }
      out[to + 10] = Math.max(0, red), out[to + 11] = Math.max(0, green), out[to + 12] = Math.max(0, blue);
    }
  }
}

/** `rest += basis coefficients` at some vertices. */
function addShapes(rest: Float32Array, rows: Int32Array, basis: Float32Array, coefficients: Float32Array): void {
  const size = coefficients.length;
  // Most coefficients of most poses are zero.
  const used = [...coefficients.keys()].filter((k) => coefficients[k] !== 0);
  for (let r = 0; r < rows.length; ++r) {
    for (let c = 0; c < 3; ++c) {
      let sum = 0;
      for (const k of used) sum += basis[(3 * r + c) * size + k] * coefficients[k];
      rest[3 * rows[r] + c] += sum;
    }
  }
}

/** `x = sum_j w_j G_j rest`. */
function skin(
  rest: Float32Array, joints: Int32Array, weights: Float32Array, transforms: Float64Array, out: Float32Array,
): void {
  const count = rest.length / 3, influences = weights.length / count;
  const m = new Float64Array(12);
  for (let v = 0; v < count; ++v) {
    m.fill(0);
    for (let k = v * influences; k < (v + 1) * influences; ++k) {
      const weight = weights[k];
      if (weight === 0) continue;
      const at = 12 * joints[k];
      for (let i = 0; i < 12; ++i) m[i] += weight * transforms[at + i];
    }
    const x = rest[3 * v], y = rest[3 * v + 1], z = rest[3 * v + 2];
    out[3 * v] = m[0] * x + m[1] * y + m[2] * z + m[3];
    out[3 * v + 1] = m[4] * x + m[5] * y + m[6] * z + m[7];
    out[3 * v + 2] = m[8] * x + m[9] * y + m[10] * z + m[11];
  }
}
