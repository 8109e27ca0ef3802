/** What the player knows of an avatar once its bundle is read: plain typed arrays, rows one after the other. */

import type { Garment } from "../cloth/garment.ts";
import type { Simulation } from "../cloth/simulation.ts";

/** Joints, and how expressions move them at rest. */
export interface Skeleton {
  names: string[];
  /** -1 at the root, which comes first; parents before children. */
  parents: Int32Array;
  /** (J, 3) metres. */
  rest: Float32Array;
  /** (J, 3, E) metres a unit of expression; empty where no joint moves. */
  byExpression: Float32Array;
}

/** The vertices that the player needs, the triangles that carry Gaussians, and what moves them at rest. */
export interface Mesh {
  /** (V, 3) in the T-pose, metres. */
  vertices: Float32Array;
  /** (F, 3) */
  faces: Int32Array;
  /** (V, k) joints and weights, rows sum to 1. */
  joints: Int32Array;
  weights: Float32Array;
  influences: number;
  /** Of every vertex, an index into `partNames`. */
  parts: Int32Array;
  expressions: RestShapes;
  /** By the entries of R_j - I of all joints but the root, 9 (J - 1) features; null where there are none. */
  correctives: RestShapes | null;
}

/** Displacements of vertices by coefficients: (R,) vertices and (R, 3, D) metres a unit. */
export interface RestShapes {
  rows: Int32Array;
  basis: Float32Array;
  size: number;
}

/** One layer: (out, in) weights and a bias. */
export interface Layer {
  inputs: number;
  outputs: number;
  weight: Float32Array;
  bias: Float32Array;
}

/** One MLP of the deformation field; the part of the first layer that sees the points is already applied to them. */
export interface FieldNetwork {
  /** (K, width): what the points bring to the first layer. */
  ofPoint: Float32Array;
  /** Of pose and code. */
  ofFrame: Layer;
  hidden: Layer[];
  last: Layer;
}

/** How the mesh leaves the T-pose, evaluated at control points and spread to the vertices. */
export interface Field {
  body: FieldNetwork;
  cloth: FieldNetwork;
  /** Control points that `cloth` is evaluated at too. */
  clothPoints: Int32Array;
  /** z of a pose that is no frame of the training. */
  code: Float32Array;
  /** (S, 21) ones and zeros: joints of theta that are seen, and which of these sets every control point is of. */
  sets: Float32Array;
  setOf: Int32Array;
  /** (V, n) control points and their weights, of every vertex. */
  neighbours: Int32Array;
  weights: Float32Array;
  neighbourCount: number;
  /** Of poses that are no frame of the training, in the networks' place; null: the networks with `code`. */
  regression: Regression | null;
}

/** `level + basis rows (clip(theta, low, high) - center)`: (K, 3) metres, (K, 3, D) metres, (D, 63) and three of 63 radians. */
export interface Regression {
  level: Float32Array;
  basis: Float32Array;
  size: number;
  rows: Float32Array;
  center: Float32Array;
  low: Float32Array;
  high: Float32Array;
}

/** Blend shapes of one side, head or body: a small network gives their coefficients. */
export interface BlendSide {
  /** (parts n) coefficients, part by part. */
  layers: Layer[];
  shapes: number;
  /** Gaussians that have them; null: all. */
  rows: Int32Array | null;
  /** (n, 6, M): metres in the triangle's frame, then colour; in steps where these are integers. */
  values: Float32Array | Int8Array;
  /** (n, 6) and (M,): a unit is `step 2^exponent`; null: 1. */
  step: Float32Array | null;
  exponent: Int32Array | null;
}

/** What moves and colours the Gaussians beyond the mesh. */
export interface BlendShapes {
  /** Driven by the expression, and by the jaw's three numbers where `jaw` is true. */
  head: BlendSide;
  /** Driven by theta. */
  body: BlendSide;
  jaw: boolean;
  /** The part of each Gaussian where parts have coefficients of their own; null: one for all. */
  part: Int32Array | null;
}

/** Poses that training saw: (T, 63) radians, and the distance within which a pose counts as one of them. */
export interface KnownPoses {
  poses: Float32Array;
  scale: number;
}

/** Gaussians on the triangles of the mesh. */
export interface Gaussians {
  count: number;
  /** They come in the order of their triangles: (N,) the triangle of each, (F + 1,) where those of a triangle begin. */
  face: Int32Array;
  first: Int32Array;
  /** (N, 2) weights of the first two corners. */
  barycentric: Float32Array;
  /** (N, 3) metres in the triangle's frame, the offset along the normal included. */
  offset: Float32Array;
  /** (N, 4) wxyz in the triangle's frame, and (N, 2) standard deviations in its plane, in its mean edge lengths. */
  quats: Float32Array;
  scales: Float32Array;
  /** Along the normal, the same for all. */
  thickness: number;
  opacity: Float32Array;
  /** (N, 3) sRGB, and (N, K, 3) harmonics of degree 1 and up. */
  color: Float32Array;
  harmonics: Float32Array;
  harmonicCount: number;
  part: Uint8Array;
  bare: BareSkin | null;
}

/** How skin lies bare whose clothes are taken off (`avatar.runtime.bundle.undressed`). */
export interface BareSkin {
  /** (N,) the part that hides each Gaussian, 0 for one that shows. */
  covered: Int32Array;
  /** (N, 3), (N, 4), (N,) and (N, 3) as those of `Gaussians`; one scale, because they are discs. */
  offset: Float32Array;
  quats: Float32Array;
  scale: Float32Array;
  color: Float32Array;
}

/** Poses in turn. */
export interface Motion {
  framesPerSecond: number;
  frames: number;
  /** (T, J, 3) axis-angle, radians. */
  rotations: Float32Array;
  /** (T, 3) metres. */
  translation: Float32Array;
  /** (T, E) */
  expression: Float32Array;
}

/** An avatar, ready to be posed. */
export interface Avatar {
  name: string;
  licence: string;
  /** What the avatar was made from, and by what. */
  provenance: Record<string, string>;
  partNames: string[];
  expressionNames: string[];
  /** Pixels squared by which splats are blurred. */
  blur: number;
  skeleton: Skeleton;
  mesh: Mesh;
  field: Field | null;
  blendShapes: BlendShapes | null;
  known: KnownPoses | null;
  gaussians: Gaussians;
  /** Loose clothes to be simulated, the inner ones first. */
  garments: Garment[];
  simulation: Simulation;
  motion: Motion | null;
  /** Of the file. */
  bytes: number;
}

/** One pose. */
export interface Pose {
  /** (J, 3) axis-angle, radians. */
  rotations: Float64Array;
  translation: Float64Array;
  expression: Float64Array;
}
