/** A fine mesh carried by a coarse one (`smplxpp/cloth/embedding.py`). */

import type { Garment } from "./garment.ts";

/** N vertices in the frames of coarse triangles: barycentric places, and offsets along tangents and smooth normal. */
export class Embedding {
  /** (N, 3) where the vertices are, metres, and the smooth unit normals there. */
  readonly points: Float32Array;
  readonly normals: Float32Array;
  private readonly smooth: Float64Array;
  /** (t, 3) the triangles that carry something, (N,) which of them each vertex has, (t, 6) their tangents. */
  private readonly triangles: Int32Array;
  private readonly which: Int32Array;
  private readonly tangents: Float64Array;

  constructor(private readonly garment: Garment) {
    const { corners } = garment, n = garment.rest.length / 3;
    const known = new Map<number, number>(), triangles: number[] = [];
    this.which = new Int32Array(corners.length / 3);
    for (let v = 0; v < this.which.length; ++v) {
      const [a, b, c] = corners.subarray(3 * v, 3 * v + 3), key = (a * n + b) * n + c;
      if (!known.has(key)) {
        known.set(key, known.size);
        triangles.push(a, b, c);
      }
      this.which[v] = known.get(key)!;
    }
    this.triangles = Int32Array.from(triangles);
    this.tangents = new Float64Array(2 * triangles.length);
    this.smooth = new Float64Array(3 * n);
    this.points = new Float32Array(corners.length);
    this.normals = new Float32Array(corners.length);
  }

  /** Moves the vertices to where particles (n, 3) take them. */
  carry(x: Float32Array): void {
    const { smooth, tangents, triangles, which, points, normals } = this, { corners, weights, offset, faces } = this.garment;
    smoothNormals(x, faces, smooth);
    for (let t = 0; t < triangles.length; t += 3) {
      const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
      const ux = x[b] - x[a], uy = x[b + 1] - x[a + 1], uz = x[b + 2] - x[a + 2];
      const vx = x[c] - x[a], vy = x[c + 1] - x[a + 1], vz = x[c + 2] - x[a + 2];
      let nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      const over = 1 / Math.max(Math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12);
      nx *= over, ny *= over, nz *= over;
      const unit = 1 / Math.max(Math.sqrt(ux * ux + uy * uy + uz * uz), 1e-12), ex = ux * unit, ey = uy * unit, ez = uz * unit;
      tangents.set([ex, ey, ez, ny * ez - nz * ey, nz * ex - nx * ez, nx * ey - ny * ex], 2 * t);
    }
    for (let v = 0; v < which.length; ++v) {
      const at = 3 * v, f = 6 * which[v];
      const a = 3 * corners[at], b = 3 * corners[at + 1], c = 3 * corners[at + 2];
      const u = weights[at], w = weights[at + 1], s = weights[at + 2];
      let nx = u * smooth[a] + w * smooth[b] + s * smooth[c];
      let ny = u * smooth[a + 1] + w * smooth[b + 1] + s * smooth[c + 1];
      let nz = u * smooth[a + 2] + w * smooth[b + 2] + s * smooth[c + 2];
      const over = 1 / Math.max(Math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12);
      nx *= over, ny *= over, nz *= over;
      const p = offset[at], q = offset[at + 1], r = offset[at + 2];
      points[at] = u * x[a] + w * x[b] + s * x[c] + p * tangents[f] + q * tangents[f + 3] + r * nx;
      points[at + 1] = u * x[a + 1] + w * x[b + 1] + s * x[c + 1] + p * tangents[f + 1] + q * tangents[f + 4] + r * ny;
      points[at + 2] = u * x[a + 2] + w * x[b + 2] + s * x[c + 2] + p * tangents[f + 2] + q * tangents[f + 5] + r * nz;
      normals[at] = nx, normals[at + 1] = ny, normals[at + 2] = nz;
    }
  }
}

/** Unit normals of vertices, faces weighted by their area. */
function smoothNormals(x: Float32Array, faces: Int32Array, out: Float64Array): void {
  out.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = x[b] - x[a], uy = x[b + 1] - x[a + 1], uz = x[b + 2] - x[a + 2];
    const vx = x[c] - x[a], vy = x[c + 1] - x[a + 1], vz = x[c + 2] - x[a + 2];
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    out[a] += nx, out[a + 1] += ny, out[a + 2] += nz;
    out[b] += nx, out[b + 1] += ny, out[b + 2] += nz;
    out[c] += nx, out[c + 1] += ny, out[c + 2] += nz;
  }
  for (let i = 0; i < out.length; i += 3) {
    const over = 1 / Math.max(Math.sqrt(out[i] ** 2 + out[i + 1] ** 2 + out[i + 2] ** 2), 1e-12);
    out[i] *= over, out[i + 1] *= over, out[i + 2] *= over;
  }
}
