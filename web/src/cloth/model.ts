/** Constraints of cloth for the solver (`smplxpp/cloth/model.py`, which has the equations). */

import { edgesOf, type Garment } from "./garment.ts";

/** Over n particles, as `smplxpp/native/cloth/xpbd.cpp` reads them. */
export interface ClothModel {
  inverseMass: Float32Array;
  /** (e, 2), metres, m/N. */
  edges: Int32Array;
  lengths: Float32Array;
  stretch: Float32Array;
  compress: Float32Array;
  /** (b, 4) the edge's ends, then the corners across it, and their weights. */
  hinges: Int32Array;
  curvature: Float32Array;
  restCurvature: Float32Array;
  bend: Float32Array;
  /** (n,) the particle that holds this one, -1 where none does, and the longest distance to it, metres. */
  anchor: Int32Array;
  tether: Float32Array;
  /** (n,) metres at rest to the nearest particle that no edge joins to it. */
  apart: Float32Array;
}

type Vector = [number, number, number];
const at = (x: Float64Array, i: number): Vector => [x[3 * i], x[3 * i + 1], x[3 * i + 2]];
const less = (a: Vector, b: Vector): Vector => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a: Vector, b: Vector) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const length = (a: Vector) => Math.sqrt(dot(a, a));

/** Derives the constraints of a garment from its shape at rest. @param fixed (n,) particles that follow their place. */
export function buildModel(garment: Garment, fixed: Uint8Array): ClothModel {
  const { rest, faces, fabric } = garment, n = rest.length / 3, m = faces.length / 3;
  const edges = edgesOf(faces, n), count = edges.length / 2;
  const areas = Float64Array.from({ length: m }, (_, f) => {
    const [a, b, c] = [0, 1, 2].map((k) => at(rest, faces[3 * f + k]));
    return 0.5 * length(cross(less(b, a), less(c, a)));
  });
  const place = new Map<number, number>();
  for (let e = 0; e < count; ++e) place.set(edges[2 * e] * n + edges[2 * e + 1], e);
  const area = new Float64Array(n), edgeArea = new Float64Array(count);
  for (let k = 0; k < 3; ++k) {
    for (let f = 0; f < m; ++f) {
      const a = faces[3 * f + k], b = faces[3 * f + ((k + 1) % 3)];
      area[a] += areas[f] / 3;
      edgeArea[place.get(Math.min(a, b) * n + Math.max(a, b))!] += areas[f];
    }
  }
  const { anchor, tether, depth } = tethers(garment, edges, fixed);
  const order = Array.from({ length: count }, (_, e) => e)
    .filter((e) => !(fixed[edges[2 * e]] && fixed[edges[2 * e + 1]]))
    // From what holds the cloth downwards: corrections then travel far within a substep.
    .sort((a, b) => depth[edges[2 * a]] + depth[edges[2 * a + 1]] - depth[edges[2 * b]] - depth[edges[2 * b + 1]]);
  const stiffness = order.map((e) => {
    const chord = length(less(at(rest, edges[2 * e]), at(rest, edges[2 * e + 1])));
    return (fabric.stretch_stiffness * Math.max(edgeArea[e], 1e-9)) / Math.max(chord, 1e-6) ** 2;
  });
  return {
    inverseMass: Float32Array.from(area, (value, i) => (fixed[i] ? 0 : 1 / (fabric.density * Math.max(value, 1e-7)))),
    edges: Int32Array.from(order.flatMap((e) => [edges[2 * e], edges[2 * e + 1]])),
    lengths: Float32Array.from(order, (e) => garment.lengths[e]),
    stretch: Float32Array.from(stiffness, (value) => 1 / value),
    compress: Float32Array.from(stiffness, (value) => 1 / (fabric.compression * value)),
    ...hinges(garment, areas, fixed),
    anchor, tether, apart: apart(rest, edges),
  };
}

/** Pairs of triangles that resist bending. */
function hinges(
  { rest, faces, fabric }: Garment, areas: Float64Array, fixed: Uint8Array,
): Pick<ClothModel, "hinges" | "curvature" | "restCurvature" | "bend"> {
  const corners: number[] = [], weights: number[] = [], curvature: number[] = [], bend: number[] = [];
  const cotangent = (i: number, p: number, q: number) => {
    const u = less(at(rest, p), at(rest, i)), v = less(at(rest, q), at(rest, i));
    // Needles would give weights without bound.
    return Math.min(Math.max(dot(u, v) / Math.max(length(cross(u, v)), 1e-12), -3), 3);
  };
  for (const [first, second] of fabric.bend_stiffness ? pairedHalfEdges(faces, rest.length / 3) : []) {
    const [f, g] = [Math.floor(first / 3), Math.floor(second / 3)], k = first % 3;
    const a = faces[3 * f + k], b = faces[3 * f + ((k + 1) % 3)];
    const c = faces[3 * f + ((k + 2) % 3)], d = faces[3 * g + ((second + 2) % 3)];
    const own = [a, b, c, d];
    if (own.every((i) => fixed[i])) continue;
    const [ac, ad, bc, bd] = [cotangent(a, b, c), cotangent(a, b, d), cotangent(b, a, c), cotangent(b, a, d)];
    const weight = [bc + bd, ac + ad, -ac - bc, -ad - bd];
    const along = less(at(rest, b), at(rest, a));
    const one = cross(along, less(at(rest, c), at(rest, a))), other = cross(less(at(rest, d), at(rest, a)), along);
    const normal: Vector = [one[0] + other[0], one[1] + other[1], one[2] + other[2]], size = Math.max(length(normal), 1e-12);
    corners.push(...own);
    weights.push(...weight);
    curvature.push(own.reduce((sum, i, j) => sum + (weight[j] * dot(at(rest, i), normal)) / size, 0));
    bend.push((areas[f] + areas[g]) / (3 * fabric.bend_stiffness));
  }
  return {
    hinges: Int32Array.from(corners), curvature: Float32Array.from(weights), restCurvature: Float32Array.from(curvature),
    bend: Float32Array.from(bend),
  };
}

/** The two half-edges `3 f + k` of every edge with exactly two faces, in the order of the edges. */
function pairedHalfEdges(faces: Int32Array, n: number): number[][] {
  const groups = new Map<number, number[]>();
  for (let h = 0; h < faces.length; ++h) {
    const a = faces[h], b = faces[h - (h % 3) + ((h + 1) % 3)], key = Math.min(a, b) * n + Math.max(a, b);
    const group = groups.get(key);
    if (group) group.push(h);
    else groups.set(key, [h]);
  }
  return [...groups].filter(([, group]) => group.length === 2).sort(([a], [b]) => a - b).map(([, group]) => group);
}

/** The distance from each particle to the nearest one that no edge joins to it. */
function apart(rest: Float64Array, edges: Int32Array): Float32Array {
  const n = rest.length / 3, squared = new Float64Array(n).fill(Infinity), joined = new Set<number>();
  for (let e = 0; e < edges.length; e += 2) joined.add(edges[e] * n + edges[e + 1]);
  for (let i = 0; i < n; ++i) {
    for (let j = i + 1; j < n; ++j) {
      const x = rest[3 * i] - rest[3 * j], y = rest[3 * i + 1] - rest[3 * j + 1], z = rest[3 * i + 2] - rest[3 * j + 2];
      const away = x * x + y * y + z * z;
      if ((away >= squared[i] && away >= squared[j]) || joined.has(i * n + j)) continue;
      squared[i] = Math.min(squared[i], away);
      squared[j] = Math.min(squared[j], away);
    }
  }
  return Float32Array.from(squared, Math.sqrt);
}

/** The nearest fixed particle along the cloth, and the longest way to it; depths along the edges. */
function tethers(garment: Garment, edges: Int32Array, fixed: Uint8Array) {
  const { rest, lengths, fabric } = garment, n = rest.length / 3;
  const near: [number, number][][] = Array.from({ length: n }, () => []);
  lengths.forEach((value, e) => {
    const [a, b] = [edges[2 * e], edges[2 * e + 1]], way = Math.max(value, 1e-9);
    near[a].push([b, way]);
    near[b].push([a, way]);
  });
  const distance = Float64Array.from(fixed, (one) => (one ? 0 : Infinity)), source = Int32Array.from(fixed.keys());
  const open = new Set([...fixed.keys()].filter((i) => fixed[i]));
  while (open.size) {
    // Dijkstra's way; cloth has hundreds of particles.
    let i = -1;
    for (const one of open) if (i < 0 || distance[one] < distance[i]) i = one;
    open.delete(i);
    for (const [j, way] of near[i]) {
      if (distance[i] + way >= distance[j]) continue;
      distance[j] = distance[i] + way;
      source[j] = source[i];
      open.add(j);
    }
  }
  const held = Array.from(distance, (value, i) => Number.isFinite(value) && !fixed[i]);
  return {
    anchor: Int32Array.from(held, (one, i) => (one ? source[i] : -1)),
    tether: Float32Array.from(held, (one, i) => {
      const straight = length(less(at(rest, i), at(rest, source[i])));
      return one ? Math.min(distance[i], 1.01 * straight + 1e-3) * (1 + fabric.slack) : 0;
    }),
    depth: distance.map((value) => (Number.isFinite(value) ? value : 0)),
  };
}
