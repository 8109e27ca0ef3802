/** An avatar in a pose: from joints to Gaussians in the world, by the runtime's kernels (`avatar/runtime/player.py`). */

import { Native, type Block } from "../native/memory.ts";
import type { Avatar, Pose, RestShapes } from "./avatar.ts";
import { BlendAdder } from "./blend.ts";
import { FieldEvaluator } from "./field.ts";
import { RegressionEvaluator } from "./regression.ts";

/**
 * Numbers of a Gaussian for the renderers: centre 3, opacity, covariance 6 (xx xy xz yy yz zz), colour 3, and
 * the normal that the eye sees, where it was asked for (folded by `web/splats.cpp`). */
export const RECORD = 14;
const BODY_JOINTS = 21;
/** What a pose takes time for, as `avatar.runtime.player` counts it. */
export const PARTS = ["pose", "field", "blend", "world"] as const;

/** Displacements (V, 3) of simulated clothes, metres, and how much of each vertex's displacement they are, (V,). */
export interface Displaced {
  displacements: Block<Float32Array>;
  share: Block<Float32Array>;
  /** (N,) what part of the body's blend shapes each Gaussian takes. */
  keep: Block<Float32Array>;
}

interface Basis {
  rows: Block<Int32Array>;
  basis: Block<Float32Array>;
  size: number;
}

/** Poses an avatar; holds the working memory. */
export class Deformer {
  /** Milliseconds of the last pose by part. */
  readonly milliseconds: Record<(typeof PARTS)[number], number> = { pose: 0, field: 0, blend: 0, world: 0 };
  /** (J, 3, 4) of the last pose: the posed body from the T-pose. */
  readonly transforms: Block<Float32Array>;
  /** (V, 3) of the last pose, in the T-pose: with expression and correctives, without the field. */
  readonly rest: Block<Float32Array>;
  /** (V, influences) joints and weights of the vertices. */
  readonly skinning: { joints: Block<Int32Array>; weights: Block<Float32Array> };
  private readonly posed: Block<Float32Array>;
  private readonly skeleton: { parents: Block<Int32Array>; turns: Block<Float64Array>; rest: Block<Float64Array>; place: Block<Float64Array> };
  private readonly features: Block<Float32Array> | null;
  private readonly shapes: { expressions: Basis; correctives: Basis | null; expression: Block<Float32Array> };
  private readonly field: FieldEvaluator | RegressionEvaluator | null;
  private readonly blend: BlendAdder | null;
  private readonly surface: Block<Uint8Array>;
  private readonly bound: Block<Uint8Array>;
  private readonly placed: Record<"offset" | "scales" | "quats" | "opacity" | "color" | "harmonics", Block<Float32Array>>;
  /** Gaussians of skin whose clothes are off, and the parts that are. */
  private bare: { rows: number[]; parts: string } = { rows: [], parts: "" };
  private readonly world: Record<"means" | "quats" | "scales" | "colors" | "rotations", Block<Float32Array>>;
  private readonly splats: Block<Uint8Array>;
  private readonly sorting: {
    row: Block<Float32Array>; part: Block<Uint8Array>; hidden: Block<Uint8Array>; order: Block<Uint32Array>;
    range: Block<Float32Array>; count: Block<Int32Array>;
  };
  private readonly eye: Block<Float32Array>;
  private readonly scratch: Block<Float32Array>;
  private readonly records: Block<Float32Array>;
  /** What normals are made of and written to; null: they were never asked for. */
  private shading: Record<"first" | "faces" | "barycentric" | "corners" | "normals", Block<Float32Array | Int32Array>> | null = null;

  constructor(readonly avatar: Avatar, private readonly clock = () => performance.now(), readonly native = new Native()) {
    const { mesh, skeleton, gaussians: g, field } = avatar;
    const J = skeleton.parents.length, V = mesh.vertices.length / 3, F = mesh.faces.length / 3, N = g.count;
    this.skeleton = {
      parents: native.keep(skeleton.parents), turns: native.room(Float64Array, 3 * J), rest: native.room(Float64Array, 3 * J),
      place: native.room(Float64Array, 3),
    };
    this.transforms = native.floats(12 * J);
    this.features = mesh.correctives && native.floats(mesh.correctives.size);
    const basis = ({ rows, basis, size }: RestShapes) => ({ rows: native.keep(rows), basis: native.keep(basis), size });
    this.shapes = {
      expressions: basis(mesh.expressions), correctives: mesh.correctives && basis(mesh.correctives),
      expression: native.floats(mesh.expressions.size),
    };
    this.field = field && (field.regression ? new RegressionEvaluator(native, field.regression) : new FieldEvaluator(native, field));
    this.blend = avatar.blendShapes && new BlendAdder(native, avatar.blendShapes, avatar.known, N);
    this.rest = native.keep(mesh.vertices);
    this.posed = native.floats(3 * V);
    this.skinning = { joints: native.keep(mesh.joints), weights: native.keep(mesh.weights) };
    this.surface = native.struct([V, J, mesh.influences, field ? field.setOf.length : 0, field ? field.neighbourCount : 0], [
      this.skinning.joints, this.skinning.weights, field && native.keep(field.neighbours), field && native.keep(field.weights),
    ]);
    const faces = native.keep(mesh.faces);
    const own = this.placed = {
      offset: native.keep(g.offset), scales: native.keep(g.scales), quats: native.keep(g.quats), opacity: native.keep(g.opacity),
      color: native.keep(g.color), harmonics: native.keep(g.harmonics),
    };
    this.bound = native.struct([F, N, V], [
      faces, native.keep(g.first), native.keep(g.barycentric), own.offset, own.scales, own.quats, own.color, [g.thickness],
    ]);
    this.world = {
      means: native.floats(3 * N), quats: native.floats(4 * N), scales: native.floats(3 * N), colors: native.floats(3 * N),
      rotations: native.floats(9 * F),
    };
    const { means, quats, scales, colors, rotations } = this.world;
    this.splats = native.struct([N, g.harmonicCount], [
      means, quats, scales, own.opacity, colors, own.harmonics, native.keep(g.face), rotations,
    ]);
    this.sorting = {
      row: native.floats(4), part: native.keep(g.part), hidden: native.room(Uint8Array, 256), order: native.room(Uint32Array, N),
      range: native.floats(2), count: native.room(Int32Array, 1),
    };
    this.eye = native.floats(3);
    this.scratch = native.floats(RECORD * N);
    this.records = native.floats(RECORD * N);
  }

  /** (N, 3) of the last pose, metres; good until the next one. */
  get centers(): Float32Array {
    return this.world.means.view;
  }

  /** (V, 3) of the last pose, metres; good until the next one. */
  get vertices(): Float32Array {
    return this.posed.view;
  }

  /** Brings skeleton and surface at rest to a pose: `transforms` and `rest`. */
  joints(pose: Pose): void {
    const { native, features, transforms, rest, shapes } = this, { mesh, skeleton } = this.avatar;
    const { parents, turns, rest: joints, place } = this.skeleton, at = joints.view, size = mesh.expressions.size;
    for (let i = 0; i < at.length; ++i) {
      let value = skeleton.rest[i];
      for (let e = 0; e < size; ++e) value += skeleton.byExpression[i * size + e] * pose.expression[e];
      at[i] = value;
    }
    turns.view.set(pose.rotations);
    place.view.set(pose.translation);
    native.run("runtime_pose", BigInt(parents.count), parents, turns, joints, place, transforms, features);
    rest.view.set(mesh.vertices);
    shapes.expression.view.set(pose.expression);
    if (pose.expression.some((value) => value !== 0)) this.shape(shapes.expressions, shapes.expression);
    if (shapes.correctives && features) this.shape(shapes.correctives, features);
  }

  /**
   * Moves everything to a pose; clothes that are simulated are where they are said to be.
   *
   * @param hidden parts that are taken off: the skin under them lies bare.
   */
  pose(pose: Pose, cloth: Displaced | null = null, hidden: Iterable<number> = []): void {
    const { native, field, blend, transforms, rest, posed, world } = this;
    const theta = Float32Array.from(pose.rotations.subarray(3, 3 + 3 * BODY_JOINTS));
    const times = [this.clock()];
    const lap = () => times.push(this.clock());
    this.joints(pose);
    lap();
    field?.evaluate(theta);
    lap();
    blend?.pose(pose, theta, cloth && cloth.keep);
    this.undress(hidden);
    for (const row of blend ? this.bare.rows : []) blend!.added.view.fill(0, 6 * row, 6 * row + 6);
    lap();
    native.run("runtime_surface", this.surface, rest, field && field.moved, cloth && cloth.displacements, cloth && cloth.share,
      transforms, posed, native.slices);
    native.run("runtime_world", this.bound, posed, blend && blend.added, world.means, world.quats, world.scales, world.colors,
      world.rotations, native.slices);
    lap();
    PARTS.forEach((part, k) => (this.milliseconds[part] = times[k + 1] - times[k]));
  }

  /**
   * Chooses the Gaussians of the last pose that are before a camera's near plane and whose part is shown.
   *
   * @param row the third row of the camera's rotation, and the z of its translation. @param hidden parts.
   * @param sorted nearest first, by depth in 16 bits; else as they come.
   * @returns how many there are, and the least and largest depth, metres.
   */
  order(row: number[], near: number, hidden: Iterable<number>, sorted: boolean): { count: number; depths: [number, number] } {
    const own = this.sorting;
    own.row.view.set(row);
    own.hidden.view.fill(0);
    for (const part of hidden) own.hidden.view[part] = 1;
    this.native.run("web_order", BigInt(this.avatar.gaussians.count), this.world.means, own.row, near, own.part, own.hidden,
      sorted ? 1 : 0, own.order, own.range, own.count);
    const [least, most] = own.range.view;
    return { count: own.count.view[0], depths: [least, most] };
  }

  /**
   * Returns `RECORD` numbers of each of the first `count` of the last order as an eye (metres) sees them; good until the
   * next pose.
   *
   * @param lit with normals.
   */
  recordsFor(eye: ArrayLike<number>, count: number, lit = false): Float32Array {
    this.eye.view.set(eye);
    const { native, splats, sorting, scratch, records } = this;
    native.run("web_records", splats, this.eye, lit ? this.normals() : null, sorting.order, BigInt(count), scratch, records, native.slices);
    return this.records.view.subarray(0, RECORD * count);
  }

  /** (N, 3) unit normals of the last pose's surface where the Gaussians hang on it. */
  private normals(): Block<Float32Array | Int32Array> {
    const { native, avatar: { mesh, gaussians: g } } = this, V = mesh.vertices.length / 3, F = mesh.faces.length / 3;
    const own = (this.shading ??= {
      faces: native.keep(mesh.faces), first: native.keep(g.first), barycentric: native.keep(g.barycentric),
      corners: native.floats(3 * V), normals: native.floats(3 * g.count),
    });
    native.run("web_normals", BigInt(V), BigInt(F), this.posed, own.faces, own.first, own.barycentric, own.corners, own.normals);
    return own.normals;
  }

  /** Lays skin bare whose clothes are off: trained under clothes, it fills the gaps between their Gaussians, in their colours. */
  private undress(hidden: Iterable<number>): void {
    const { placed, avatar: { gaussians: g } } = this, { bare } = g, off = new Set(hidden), parts = [...off].sort().join();
    if (!bare || parts === this.bare.parts) return;
    const { offset, scales, quats, opacity, color, harmonics } = placed, K = 3 * g.harmonicCount;
    const rows = Array.from(bare.covered.keys()).filter((i) => bare.covered[i] && !off.has(g.part[i]) && off.has(bare.covered[i]));
    this.bare = { rows, parts };
    for (const name of ["offset", "scales", "quats", "opacity", "color", "harmonics"] as const) placed[name].view.set(g[name]);
    for (const i of rows) {
      offset.view.set(bare.offset.subarray(3 * i, 3 * i + 3), 3 * i);
      quats.view.set(bare.quats.subarray(4 * i, 4 * i + 4), 4 * i);
      color.view.set(bare.color.subarray(3 * i, 3 * i + 3), 3 * i);
      scales.view.fill(bare.scale[i], 2 * i, 2 * i + 2);
      harmonics.view.fill(0, K * i, K * (i + 1));
      opacity.view[i] = 1;
    }
  }

  private shape({ rows, basis, size }: Basis, coefficients: Block<Float32Array>): void {
    const { native, rest } = this;
    native.run("runtime_basis", BigInt(rows.count), BigInt(size), BigInt(rest.count / 3), rows, basis, coefficients, rest);
  }
}
