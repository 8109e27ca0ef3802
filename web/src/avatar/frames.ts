/** The frame of every triangle: where its Gaussians hang (`avatar/gaussians/frames.py`). */

/** Metres: mean edges are at least this long. */
const MIN_EDGE = 1e-6;
/** A hundred times the precision of the vertices: triangles flatter than this have no normal of their own. */
const TOLERANCE = 100 * 1.1920929e-7;

/**
 * Writes (F, 9) rotations, whose columns are the normal, the direction from the first corner to the middle of the
 * opposite edge and their cross product, and (F,) mean edge lengths.
 */
export function triangleFrames(
  vertices: Float32Array, faces: Int32Array, rotations: Float32Array, lengths: Float32Array,
): void {
  for (let f = 0; f < lengths.length; ++f) {
    const a = 3 * faces[3 * f], b = 3 * faces[3 * f + 1], c = 3 * faces[3 * f + 2];
    const ux = vertices[b] - vertices[a], uy = vertices[b + 1] - vertices[a + 1], uz = vertices[b + 2] - vertices[a + 2];
    const vx = vertices[c] - vertices[a], vy = vertices[c + 1] - vertices[a + 1], vz = vertices[c + 2] - vertices[a + 2];
    const edges = length(ux, uy, uz) + length(vx, vy, vz) + length(vx - ux, vy - uy, vz - uz);
    const edge = Math.max(edges / 3, MIN_EDGE);
    let nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    let qx = 0.5 * (ux + vx), qy = 0.5 * (uy + vy), qz = 0.5 * (uz + vz);
    if (length(nx, ny, nz) <= TOLERANCE * edge * edge) {
      // No area: some direction across the longest.
      if (length(qx, qy, qz) <= TOLERANCE * (edges / 3)) [qx, qy, qz] = [ux, uy, uz];
      if (length(qx, qy, qz) <= TOLERANCE * MIN_EDGE) [qx, qy, qz] = [1, 0, 0];
      [nx, ny, nz] = across(qx, qy, qz);
    }
    const n = 1 / length(nx, ny, nz), q = 1 / length(qx, qy, qz);
    nx *= n, ny *= n, nz *= n;
    qx *= q, qy *= q, qz *= q;
    const at = 9 * f;
    rotations[at] = nx, rotations[at + 1] = qx, rotations[at + 2] = ny * qz - nz * qy;
    rotations[at + 3] = ny, rotations[at + 4] = qy, rotations[at + 5] = nz * qx - nx * qz;
    rotations[at + 6] = nz, rotations[at + 7] = qz, rotations[at + 8] = nx * qy - ny * qx;
    lengths[f] = edge;
  }
}

function length(x: number, y: number, z: number): number {
  return Math.sqrt(x * x + y * y + z * z);
}

/** The cross product with the axis that is farthest from the vector. */
function across(x: number, y: number, z: number): [number, number, number] {
  const [a, b, c] = [Math.abs(x), Math.abs(y), Math.abs(z)];
  if (a <= b && a <= c) return [0, z, -y];
  return b <= c ? [-z, 0, x] : [y, -x, 0];
}
