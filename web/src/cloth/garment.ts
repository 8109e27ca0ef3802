/** A loose part of an avatar as something to simulate (`smplxpp/cloth/garment.py`). */

import type { Pose } from "../avatar/avatar.ts";

/** What cloth is made of, in SI units (`smplxpp/cloth/model.py`). */
export interface Fabric {
  density: number;
  stretch_stiffness: number;
  compression: number;
  bend_stiffness: number;
  slack: number;
  drag: number;
  normal_drag: number;
  inner_friction: number;
  friction: number;
}

/** n particles that carry N of the avatar's vertices. */
export interface Garment {
  part: string;
  fabric: Fabric;
  /** Of its particles, metres. */
  spacing: number;
  /** Metres along the cloth up to which it follows the body exactly, and over which simulation takes over. */
  pinDepth: number;
  band: number;
  /** The pose that it was scanned in. */
  reference: Pose;
  /** (n,) vertices of the avatar; (n, 3) metres in the reference pose; (m, 3). */
  particles: Int32Array;
  rest: Float64Array;
  faces: Int32Array;
  /** (e,) of the edges in their order, metres along the cloth. */
  lengths: Float64Array;
  /** (n,) and (N,) metres along the cloth from what holds it. */
  depth: Float64Array;
  vertexDepth: Float64Array;
  /** (N,) vertices of the avatar that it carries; (N, 3) corners among the particles, weights, offsets in metres. */
  vertices: Int32Array;
  corners: Int32Array;
  weights: Float32Array;
  offset: Float32Array;
  /** What it may touch: (c,) vertices of the avatar, (d, 3) faces among them, metres. */
  collider: { vertices: Int32Array; faces: Int32Array; margin: Float32Array; deepest: Float32Array };
}

/** The undirected edges of faces over n vertices, each once, lower index first, sorted: (E, 2); -1: no vertex. */
export function edgesOf(faces: Int32Array, n: number): Int32Array {
  const keys = new Set<number>();
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 3; ++k) {
      const a = faces[f + k], b = faces[f + ((k + 1) % 3)];
      if (a >= 0 && b >= 0) keys.add(Math.min(a, b) * n + Math.max(a, b));
    }
  }
  return Int32Array.from([...keys].sort((a, b) => a - b).flatMap((key) => [Math.floor(key / n), key % n]));
}

/** (n,) 1 where a particle follows the body exactly: within the pin depth, at least the nearest ones of each piece. */
export function pinned(garment: Garment): Uint8Array {
  const { depth, faces, pinDepth } = garment, piece = Int32Array.from(depth.keys());
  const root = (i: number): number => {
    while (piece[i] !== i) i = piece[i] = piece[piece[i]];
    return i;
  };
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 3; ++k) piece[root(faces[f + k])] = root(faces[f + ((k + 1) % 3)]);
  }
  const least = new Float64Array(depth.length).fill(Infinity);
  depth.forEach((value, i) => (least[root(i)] = Math.min(least[root(i)], value)));
  return Uint8Array.from(depth, (value, i) => (value <= Math.max(pinDepth, least[root(i)]) ? 1 : 0));
}

/** (N,) how much of each vertex's displacement is the simulation's: 0 at the pins, 1 beyond the band. */
export function shareOf({ vertexDepth, pinDepth, band }: Garment): Float32Array {
  return Float32Array.from(vertexDepth, (depth) => {
    const t = Math.min(Math.max((depth - pinDepth) / band, 0), 1);
    return Number.isFinite(depth) ? t * t * (3 - 2 * t) : 0;
  });
}
