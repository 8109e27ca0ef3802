/** Loose clothes along a motion, pose after pose (`smplxpp/cloth/driver.py`, which has the equations). */

import type { Pose } from "../avatar/avatar.ts";
import type { Deformer, Displaced } from "../avatar/deform.ts";
import { between } from "../avatar/motion.ts";
import { BundleError, EXPORT_AGAIN } from "../bundle/errors.ts";
import { multiply, quaternionFromRotvec, rotvecFromQuaternion } from "../math/rotations.ts";
import type { Block } from "../native/memory.ts";
import { SkinnedRows } from "./carried.ts";
import type { Garment } from "./garment.ts";
import type { Simulation } from "./simulation.ts";
import { GarmentThread } from "./thread.ts";

/** Metres from where what holds the cloth was at the last cold start, within which that start serves again. */
const AGAIN = 0.06;
/** Metres between a vertex and the particle that is one. */
const SAME = 1e-4;
/** Seconds between pictures beyond which a motion is not followed. */
export const LONGEST_FOLLOWED = 1;

/** What a garment needs of the surface: vertices of the avatar and what moves them. */
interface Rows {
  particles: SkinnedRows;
  collider: SkinnedRows;
  carried: SkinnedRows;
  /** Of each vertex of the collider the vertex that an inner garment carries: [garment, index]. */
  under: Map<number, [number, number]>;
  /** Carried vertices that follow each other in the avatar, too: [from, to, the avatar's first]. */
  runs: [number, number, number][];
}

export class ClothDriver {
  private readonly threads: GarmentThread[];
  private readonly rows: Rows[];
  private readonly displaced: Displaced;
  /** (V, 3) the T-pose: without expression, and with the body's shape of the moment where steps need it. */
  private readonly still: Block<Float32Array>;
  private readonly shapedRest: Block<Float32Array>;
  /** How many vertices are the body's: the first ones. */
  private readonly skin: number;
  /** What places are measured from: near the person, so that float32 knows micrometres wherever that stands. */
  private origin = [0, 0, 0];
  private last: Pose | null = null;
  /** Goes back to the end of the last cold start. */
  private begun: (() => void) | null = null;

  private readonly numbers: Simulation;

  /** @param start in the place of how the avatar says that its garments start cold, seconds. */
  constructor(private readonly deformer: Deformer, garments: readonly Garment[], start: Partial<Pick<Simulation, "ramp" | "hold">> = {}) {
    const { native, avatar: { mesh, gaussians, simulation } } = deformer, V = mesh.vertices.length / 3;
    const numbers = (this.numbers = { ...simulation, ...start });
    this.rows = garments.map(({ particles, collider, vertices }, k) => {
      const under = new Map<number, [number, number]>();
      garments.slice(0, k).forEach(({ vertices }, inner) => {
        const place = new Map(Array.from(vertices, (vertex, i) => [vertex, i]));
        collider.vertices.forEach((vertex, i) => place.has(vertex) && under.set(i, [inner, place.get(vertex)!]));
      });
      const [own, touched, carried] = [particles, collider.vertices, vertices].map((rows) => new SkinnedRows(deformer, rows));
      return { particles: own, collider: touched, carried, under, runs: runsOf(vertices) };
    });
    const inner = this.rows.map(({ under }) => new Set([...under.values()].map(([one]) => one)));
    const layered = garments.map((_, k) => inner[k].size > 0 || inner.some((ones) => ones.has(k)));
    this.threads = garments.map((garment, k) => new GarmentThread(native, garment, mesh.faces, numbers, layered[k]));
    [this.still, this.shapedRest] = [native.keep(mesh.vertices), native.keep(mesh.vertices)];
    this.skin = mesh.parts.filter((part) => !part).length;
    const share = new Float32Array(V);
    this.threads.forEach(({ garment, share: own }) => garment.vertices.forEach((vertex, i) => (share[vertex] = own[i])));
    const keep = Float32Array.from(gaussians.face, (face) => {
      const corners = mesh.faces.subarray(3 * face, 3 * face + 3);
      return 1 - (share[corners[0]] + share[corners[1]] + share[corners[2]]) / 3;
    });
    this.displaced = { displacements: native.floats(3 * V), share: native.keep(share), keep: native.keep(keep) };
    garments.forEach(({ reference, rest }, k) => this.checkPlaces(reference, rest, this.rows[k].particles));
  }

  /** Refuses a garment of another avatar: its particles are vertices of this one in the reference pose. */
  private checkPlaces(reference: Pose, rest: Float64Array, particles: SkinnedRows): void {
    this.measureFrom(this.root(reference));
    this.joints(reference);
    const off = this.places(particles).reduce((most, value, i) => Math.max(most, Math.abs(value + this.origin[i % 3] - rest[i])), 0);
    if (!(off < SAME)) throw new BundleError("garments of the avatar", "particles that are its vertices", `some that are ${(1e3 * off).toPrecision(3)} mm off`, EXPORT_AGAIN);
  }

  /** (n, 3) where the particles of each garment are in the world, metres. */
  get particles(): Float32Array[] {
    return this.threads.map(({ position }) => position.view.map((value, i) => value + this.origin[i % 3]));
  }

  /** The speed of the fastest particle, metres a second. */
  get speed(): number {
    return Math.max(...this.threads.map((thread) => thread.speed));
  }

  /** Forgets the state: the next step starts cold. */
  restart(): void {
    this.last = null;
  }

  /** Goes on to a pose `seconds` after the last as `step` does, by poses between them where pictures are far apart. */
  follow(pose: Pose, seconds: number): Displaced {
    if (this.last && seconds === 0) return this.shaped(pose);
    const steps = Math.max(1, Math.ceil(seconds / this.numbers.longest_step)), { last } = this;
    if (!(seconds <= LONGEST_FOLLOWED)) this.restart();
    else if (last) for (let k = 1; k < steps; ++k) this.move(between(last, pose, k / steps), seconds / steps);
    return this.step(pose, seconds / steps);
  }

  /** Goes on to a pose; the first one, and one that cloth could not have followed to, start cold. */
  step(pose: Pose, seconds: number): Displaced {
    this.move(pose, seconds);
    return this.laid();
  }

  private move(pose: Pose, seconds: number): void {
    if (!this.last || !(seconds > 0 && seconds <= this.numbers.longest_step) || !this.advance(pose, seconds, false)) this.begin(pose);
    this.last = pose;
  }

  /** Comes to a first pose from the reference pose, where the cloth hangs as it was scanned. */
  private begin(pose: Pose): void {
    if (this.again(pose)) return;
    const start = facingAs(this.threads[0].garment.reference, pose);
    const { ramp, hold, ramp_step } = this.numbers, steps = Math.round(ramp / ramp_step), still = Math.round(hold / ramp_step);
    this.measureFrom(this.root(pose));
    this.joints(steps ? start : pose);
    this.threads.forEach((thread, k) => thread.reset(this.places(this.rows[k].particles), this.places(this.rows[k].collider)));
    for (let k = 1; k < steps; ++k) {
      const t = k / steps;
      this.advance(between(start, pose, t * t * (3 - 2 * t)), ramp_step, true);
    }
    for (let k = 0; k < still + Math.min(steps, 1); ++k) this.advance(pose, ramp_step, true);
    const { origin } = this, back = this.threads.map((thread) => thread.kept());
    this.begun = () => {
      this.measureFrom(origin);
      for (const one of back) one();
    };
  }

  /** Starts as the last time, where the pose is nearly that of then: a motion that is played in a loop does not halt. */
  private again(pose: Pose): boolean {
    if (!this.begun) return false;
    this.begun();
    this.joints(pose);
    if (this.rows.some(({ particles }, k) => this.threads[k].wayTo(this.places(particles)) > AGAIN)) return false;
    return this.advance(pose, this.numbers.ramp_step, true);
  }

  /** Moves all garments on to a pose; false, and nothing moved, where what holds them went too fast. */
  private advance(pose: Pose, seconds: number, atAnySpeed: boolean): boolean {
    const root = this.root(pose), away = root.map((value, k) => value - this.origin[k]);
    if (away.some((value) => Math.abs(value) > this.numbers.wander)) {
      this.measureFrom(root);
      for (const thread of this.threads) thread.shift(away.map((value) => -value));
    }
    this.joints(pose);
    const own = this.rows.map(({ particles }) => this.places(particles));
    if (!atAnySpeed && own.some((places, k) => this.threads[k].wayTo(places) > this.numbers.teleport * seconds)) return false;
    this.threads.forEach((thread, k) => {
      const { collider, under } = this.rows[k], surface = this.places(collider);
      // Where an inner garment lies it counts as it is.
      for (const inner of new Set([...under.values()].map(([one]) => one))) this.threads[inner].carry();
      for (const [i, [inner, at]] of under) {
        const { carried, share } = this.threads[inner], { view } = carried;
        for (let c = 0; c < 3; ++c) surface[3 * i + c] += share[at] * (view[3 * at + c] - surface[3 * i + c]);
      }
      thread.advance(own[k], surface, seconds);
    });
    return true;
  }

  /** Where the first joint is in the world, metres. */
  private root({ translation, expression }: Pose): number[] {
    const { rest, byExpression } = this.deformer.avatar.skeleton, size = expression.length;
    return [0, 1, 2].map((k) => expression.reduce((sum, value, e) => sum + byExpression[k * size + e] * value, rest[k] + translation[k]));
  }

  /** Takes places from another origin, world, metres. */
  private measureFrom(origin: number[]): void {
    const { floor } = this.numbers;
    this.origin = origin;
    for (const thread of this.threads) thread.floor = floor === null ? null : floor - origin[1];
  }

  /** Brings the skeleton to a pose, measured from the origin. */
  private joints(pose: Pose): void {
    this.deformer.joints({ ...pose, translation: pose.translation.map((value, k) => value - this.origin[k]) });
    this.shapedRest.view.set(this.deformer.rest.view.subarray(0, 3 * this.skin));
  }

  /** Where skinning has some vertices, (R, 3) metres from the origin; the parts know no expression. */
  private places(rows: SkinnedRows): Float32Array {
    return rows.pose(this.shapedRest).slice();
  }

  /** Takes the cloth as it is back to the T-pose. */
  private shaped(pose: Pose): Displaced {
    this.joints(pose);
    return this.laid();
  }

  /** The same where the skeleton is in the pose. */
  private laid(): Displaced {
    for (const thread of this.threads) thread.carry();
    this.threads.forEach(({ carried }, k) => {
      const found = this.rows[k].carried.unpose(this.still, carried), out = this.displaced.displacements.view;
      for (const [from, to, vertex] of this.rows[k].runs) out.set(found.subarray(3 * from, 3 * to), 3 * vertex);
    });
    return this.displaced;
  }
}

/** Where vertices follow each other: copies of whole runs cost little before a page's code is compiled well. */
function runsOf(vertices: Int32Array): [number, number, number][] {
  const runs: [number, number, number][] = [];
  vertices.forEach((vertex, i) => {
    const last = runs[runs.length - 1];
    if (last && vertex === last[2] + i - last[0]) last[1] = i + 1;
    else runs.push([i, i + 1, vertex]);
  });
  return runs;
}

/** A pose where another one stands and looks: its place, turned about the vertical alone. */
function facingAs(reference: Pose, pose: Pose): Pose {
  const [own, its] = [reference, pose].map(({ rotations }) => quaternionFromRotvec(rotations, 0));
  const heading = ([w, x, y, z]: number[]) => Math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y));
  const half = 0.5 * (heading(its) - heading(own)), rotations = reference.rotations.slice();
  rotations.set(rotvecFromQuaternion(multiply([Math.cos(half), 0, Math.sin(half), 0], own)));
  return { ...reference, rotations, translation: pose.translation };
}
