/** Kernels of what cloth carries (`smplxpp/cloth/embedding.py`): fine vertices over particles, and vertices to the T-pose. */

import type { Deformer } from "../avatar/deform.ts";
import type { Block, Native } from "../native/memory.ts";
import { edgesOf, type Garment } from "./garment.ts";
import type { Simulation } from "./simulation.ts";

/** Metres at which there is nothing. */
const FAR_AWAY = 1e6;

/** N vertices in the frames of coarse triangles: barycentric places, and offsets along tangents and smooth normal. */
export class CarriedVertices {
  /** (N, 3) where the vertices are, metres. */
  readonly points: Block<Float32Array>;
  private readonly carried: Block<Uint8Array>;

  /** @param deepest of the collider, @param faces its faces, @param drawn the faces of the avatar. */
  constructor(
    private readonly native: Native, garment: Garment, deepest: Block<Float32Array>, faces: Block<Int32Array>, drawn: ArrayLike<number>,
    numbers: Simulation,
  ) {
    const { corners, weights, offset, rest, collider } = garment, n = rest.length / 3, which = new Int32Array(corners.length / 3);
    const known = new Map<number, number>(), triangles: number[] = [];
    for (let v = 0; v < which.length; ++v) {
      const [a, b, c] = corners.subarray(3 * v, 3 * v + 3), key = (a * n + b) * n + c;
      if (!known.has(key)) {
        known.set(key, known.size);
        triangles.push(a, b, c);
      }
      which[v] = known.get(key)!;
    }
    const edges = carriedEdges(garment, drawn, numbers.beside), most = native.keep(new Float32Array(edges.length / 2).fill(Infinity));
    this.points = native.floats(corners.length);
    this.carried = native.struct(
      [which.length, known.size, n, garment.faces.length / 3, collider.vertices.length, collider.faces.length / 3, edges.length / 2],
      [...[Int32Array.from(triangles), which, weights, offset, garment.faces].map((array) => native.keep<Float32Array | Int32Array>(array)),
        faces, deepest, native.keep(edges), most],
    );
    // Where the garment carries them at rest, with nothing about, says how long edges are.
    const nothing = native.keep(new Float32Array(3 * collider.vertices.length).fill(FAR_AWAY));
    this.carry(native.keep(Float32Array.from(rest)), nothing, 0);
    const x = this.points.view;
    most.view.forEach((_, e) => {
      const [a, b] = [3 * edges[2 * e], 3 * edges[2 * e + 1]];
      most.view[e] = numbers.most_drawn * Math.max(Math.hypot(x[a] - x[b], x[a + 1] - x[b + 1], x[a + 2] - x[b + 2]), numbers.sliver);
    });
  }

  /** Moves the vertices to where particles (n, 3) take them, `margin` metres before the collider's surface (c, 3). */
  carry(particles: Block<Float32Array>, surface: Block<Float32Array>, margin: number): void {
    this.native.run("cloth_carry", this.carried, particles, surface, margin, this.points);
  }
}

/**
 * The edges of faces (F, 3) of the avatar that a garment carries, as pairs of its vertices; bridges over openings, which lie
 * `beside` metres in the plane of the triangle that carries them, are none.
 */
function carriedEdges({ vertices, offset }: Garment, faces: ArrayLike<number>, beside: number): Int32Array {
  const at = new Map<number, number>();
  vertices.forEach((vertex, i) => Math.max(Math.abs(offset[3 * i]), Math.abs(offset[3 * i + 1])) < beside && at.set(vertex, i));
  return edgesOf(Int32Array.from(faces, (vertex) => at.get(vertex) ?? -1), vertices.length);
}

/** R vertices under linear blend skinning, there and back. */
export class SkinnedRows {
  /** (R, 3) places after `pose`, displacements after `unpose`, metres; good until the next of them. */
  readonly out: Block<Float32Array>;
  private readonly rows: Block<Uint8Array>;

  constructor(private readonly deformer: Deformer, rows: Int32Array) {
    const { native, skinning, avatar: { mesh, skeleton } } = deformer;
    this.out = native.floats(3 * rows.length);
    this.rows = native.struct([rows.length, mesh.vertices.length / 3, skeleton.parents.length, mesh.influences],
      [native.keep(rows), skinning.joints, skinning.weights]);
  }

  /** Where the deformer's transforms take them from rest (V, 3). */
  pose(rest: Block<Float32Array>): Float32Array {
    const { native, transforms } = this.deformer;
    native.run("cloth_posed", this.rows, transforms, rest, this.out);
    return this.out.view;
  }

  /** The displacements in the T-pose that the deformer's transforms take to places (R, 3). */
  unpose(rest: Block<Float32Array>, places: Block<Float32Array>): Float32Array {
    const { native, transforms, avatar } = this.deformer;
    native.run("cloth_unposed", this.rows, transforms, rest, places, avatar.simulation.least_determinant, this.out);
    return this.out.view;
  }
}
