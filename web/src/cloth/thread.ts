/** One garment through time: its particles, and where skinning had it at the last moments (`smplxpp/cloth/thread.py`). */

import type { Block, Native } from "../native/memory.ts";
import { CarriedVertices } from "./carried.ts";
import { pinned, shareOf, type Garment } from "./garment.ts";
import { buildModel } from "./model.ts";
import type { Simulation } from "./simulation.ts";

/** Places of the last moment but one, the last, now, and the next as it would come without acceleration. */
class Moments {
  readonly blocks: Block<Float32Array>[];
  private known = 0;

  constructor(native: Native, count: number) {
    this.blocks = Array.from({ length: 4 }, () => native.floats(3 * count));
  }

  /** The last places that were told. */
  get now(): Float32Array {
    return this.blocks[2].view;
  }

  restart(places: Float32Array): void {
    this.now.set(places);
    this.known = 1;
  }

  tell(places: Float32Array): void {
    const [before, last, now, next] = this.blocks.map((block) => block.view);
    if (this.known > 1) before.set(last);
    last.set(now);
    if (this.known < 2) for (let i = 0; i < now.length; ++i) before[i] = 2 * last[i] - places[i];
    now.set(places);
    for (let i = 0; i < now.length; ++i) next[i] = 2 * now[i] - last[i];
    this.known = 2;
  }

  kept(): () => void {
    const { known } = this, copies = this.blocks.map(({ view }) => view.slice());
    return () => {
      this.known = known;
      copies.forEach((copy, k) => this.blocks[k].view.set(copy));
    };
  }

  shift(by: readonly number[]): void {
    for (const { view } of this.blocks) for (let i = 0; i < view.length; ++i) view[i] += by[i % 3];
  }
}

export class GarmentThread {
  /** (n, 3) metres from the driver's origin, and metres a second. */
  readonly position: Block<Float32Array>;
  readonly velocity: Block<Float32Array>;
  /** (N,) */
  readonly share: Float32Array;
  private readonly pins: Int32Array;
  private readonly mostSquared: Float64Array;
  private readonly edges: Int32Array;
  private readonly fine: CarriedVertices;
  private readonly model: Block<Uint8Array>;
  private readonly forces: Block<Float64Array>;
  /** Height of the ground, metres from the driver's origin; null: there is none. */
  floor: number | null = null;
  private readonly moments: Block<Uint8Array>;
  private readonly places: Moments;
  private readonly surfaces: Moments;

  /** @param drawn the faces of the avatar. @param layered whether it touches another garment: its particles stay their spacing apart then. */
  constructor(
    private readonly native: Native, readonly garment: Garment, drawn: ArrayLike<number>, private readonly numbers: Simulation,
    layered: boolean,
  ) {
    const { gravity, own_margin, most_speed, most_stretch } = numbers.solver;
    const { fabric, collider } = garment, n = garment.particles.length, c = collider.vertices.length;
    const fixed = pinned(garment), model = buildModel(garment, fixed);
    this.pins = Int32Array.from([...fixed.keys()].filter((i) => fixed[i]));
    this.share = shareOf(garment);
    this.edges = model.edges;
    this.mostSquared = Float64Array.from(model.lengths, (length) => (numbers.most_stretch * length + 0.01) ** 2);
    [this.position, this.velocity] = [native.floats(3 * n), native.floats(3 * n)];
    const colliderFaces = native.keep(collider.faces), deepest = native.keep(collider.deepest);
    this.fine = new CarriedVertices(native, garment, deepest, colliderFaces, drawn, numbers);
    this.model = native.struct([n, garment.faces.length / 3, model.edges.length / 2, model.bend.length, c, collider.faces.length / 3], [
      ...[model.inverseMass, garment.faces, model.edges, model.lengths, model.stretch, model.compress, model.hinges, model.curvature,
        model.restCurvature, model.bend].map((array) => native.keep<Float32Array | Int32Array>(array)),
      null, native.keep(model.anchor), native.keep(model.tether), native.keep(model.apart), colliderFaces, native.keep(collider.margin),
      deepest,
    ]);
    this.forces = native.keep(Float64Array.of(
      gravity, fabric.drag, fabric.normal_drag, fabric.inner_friction, fabric.friction, layered ? Math.max(own_margin, garment.spacing) : own_margin,
      most_speed, most_stretch, 0));
    [this.places, this.surfaces] = [new Moments(native, n), new Moments(native, c)];
    this.moments = native.struct([], [...this.places.blocks, ...this.surfaces.blocks]);
  }

  /** Puts the particles where skinning has them, at rest. */
  reset(places: Float32Array, surface: Float32Array): void {
    this.rest(places);
    this.places.restart(places);
    this.surfaces.restart(surface);
  }

  /** The longest way, metres, of what holds the garment from the last moment to places (n, 3). */
  wayTo(places: Float32Array): number {
    const { now } = this.places;
    let most = 0;
    for (const i of this.pins) {
      most = Math.max(most, Math.hypot(places[3 * i] - now[3 * i], places[3 * i + 1] - now[3 * i + 1], places[3 * i + 2] - now[3 * i + 2]));
    }
    return most;
  }

  /** Goes on to new places of the particles (n, 3) and of what they touch (c, 3); where that breaks down, to the body. */
  advance(places: Float32Array, surface: Float32Array, seconds: number): void {
    this.places.tell(places);
    this.surfaces.tell(surface);
    const { substep, contacts_every } = this.numbers.solver, substeps = Math.max(1, Math.ceil(seconds / substep - 1e-6));
    this.native.run("cloth_advance", this.model, this.forces, this.moments, seconds, substeps, contacts_every, this.position, this.velocity);
    if (!this.sound()) this.rest(places);
    else if (this.floor !== null) this.layOn(this.floor + this.numbers.drawn_margin);
  }

  /** Brings what the garment carries to where the particles are, `drawn_margin` outside of what it touches. */
  carry(): void {
    this.fine.carry(this.position, this.surfaces.blocks[2], this.numbers.drawn_margin);
    if (this.floor === null) return;
    const { view } = this.carried, floor = Math.fround(this.floor);
    for (let i = 1; i < view.length; i += 3) view[i] = Math.max(view[i], floor);
  }

  /** Lifts what sank below the ground onto it; Coulomb's friction against what it fell with. */
  private layOn(height: number): void {
    const x = this.position.view, v = this.velocity.view, { friction } = this.garment.fabric;
    for (let i = 0; i < x.length; i += 3) {
      if (x[i + 1] >= height) continue;
      const stopped = Math.max(-v[i + 1], 0), speed = Math.hypot(v[i], v[i + 2]);
      const left = Math.max(speed - friction * stopped, 0) / Math.max(speed, 1e-9);
      x[i + 1] = height;
      v[i] *= left;
      v[i + 1] += stopped;
      v[i + 2] *= left;
    }
  }

  /** (N, 3) where the carried vertices are, after `carry`. */
  get carried(): Block<Float32Array> {
    return this.fine.points;
  }

  /** Remembers the garment as it is; what it returns brings it back to that. */
  kept(): () => void {
    const back = [this.places.kept(), this.surfaces.kept()];
    const copies = [this.position, this.velocity].map((block) => [block, block.view.slice()] as const);
    return () => {
      for (const one of back) one();
      for (const [block, copy] of copies) block.view.set(copy);
    };
  }

  /** Moves all that is remembered, metres. */
  shift(by: readonly number[]): void {
    const { view } = this.position;
    for (let i = 0; i < view.length; ++i) view[i] += by[i % 3];
    this.places.shift(by);
    this.surfaces.shift(by);
  }

  /** The speed of the fastest particle that is not held, metres a second, against places that do not move. */
  get speed(): number {
    const { view } = this.velocity;
    let most = 0;
    for (let i = 0; i < view.length; i += 3) most = Math.max(most, view[i] ** 2 + view[i + 1] ** 2 + view[i + 2] ** 2);
    return Math.sqrt(most);
  }

  private rest(places: Float32Array): void {
    this.position.view.set(places);
    this.velocity.view.fill(0);
  }

  private sound(): boolean {
    const x = this.position.view, v = this.velocity.view, { edges, mostSquared } = this;
    let sum = 0;  // as double: finite where all are
    for (let i = 0; i < x.length; ++i) sum += x[i] + v[i];
    if (!Number.isFinite(sum)) return false;
    for (let e = 0; e < mostSquared.length; ++e) {
      const a = 3 * edges[2 * e], b = 3 * edges[2 * e + 1];
      if (!((x[a] - x[b]) ** 2 + (x[a + 1] - x[b + 1]) ** 2 + (x[a + 2] - x[b + 2]) ** 2 <= mostSquared[e])) return false;
    }
    return true;
  }
}
