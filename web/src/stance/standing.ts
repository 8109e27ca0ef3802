/** Somebody who stands, breathes and looks about, and moves her hands while she speaks: by the tables of `avatar.driving.stance_of`. */

import type { Performer } from "../animator.ts";
import type { Pose } from "../avatar/avatar.ts";
import { turned } from "../avatar/motion.ts";
import { BundleError } from "../bundle/errors.ts";
import { asInteger, asObject } from "../bundle/json.ts";
import type { Piece } from "../bundle/tensors.ts";
import { poseOfRow } from "../chat/wire.ts";
import type { Phone } from "../lips/visemes.ts";
import { Arms, numbersOf } from "./arms.ts";

/** Radians by which a whole beat lowers head and neck together (`avatar.speech.speech_animation`). */
const NODS = (2.2 * Math.PI) / 180;
const FINGERS = ["index", "middle", "pinky", "ring"], SIDES = ["left", "right"];

export class Standing implements Performer {
  readonly arms: Arms;
  private readonly row: Float32Array;
  private readonly columns: ArrayLike<number>;
  private readonly idle: ArrayLike<number>;
  private readonly rate: number;
  /** Where the rotations of the arms' six joints are; of the fingers' joints, with the hand and which flexion moves them. */
  private readonly joints: number[];
  private readonly fingers: [joint: number, side: number, flexion: number][] = [];
  private readonly nodding: number[];
  private readonly began = performance.now();

  private constructor({ tensors, about }: Piece, private readonly jointNames: readonly string[], private readonly expressions: number) {
    const take = (name: string, ...shape: (number | null)[]) => {
      const found = tensors.get(`body.${name}`);
      if (found && found.shape.length === shape.length && shape.every((n, k) => n === null || n === found.shape[k])) return found;
      throw new BundleError(`the stance's ${name}`, `shape (${shape.map((n) => n ?? "any").join(", ")})`, found ? `(${found.shape.join(", ")})` : "none", "write the page anew");
    };
    const width = 3 * jointNames.length + 3 + expressions, columns = take("columns", null), idle = take("idle", null, columns.shape[0]);
    this.row = Float32Array.from(take("standing", width).values);
    this.columns = Array.from(columns.values, (column) => asInteger(column, "a column of the stance", 0, width - 1));
    this.idle = idle.values;
    const states = take("states", null, 22), count = states.shape[0], numbers = numbersOf(asObject(about.gestures, "gestures"));
    this.rate = numbers.fps;
    this.arms = new Arms(
      { rest: Float64Array.from(take("rest", 22).values), states: Float64Array.from(states.values), clear: take("clear", count + 1, count + 1).values, count }, numbers,
    );
    const joint = (name: string) => jointNames.indexOf(name);
    this.joints = SIDES.flatMap((side) => ["shoulder", "elbow", "wrist"].map((name) => joint(`${side}_${name}`)));
    SIDES.forEach((side, k) => FINGERS.forEach((finger, f) => [1, 2, 3].forEach((n) => {
      const at = joint(`${side}_${finger}${n}`);
      if (at >= 0) this.fingers.push([at, k, f ? 1 : 0]);
    })));
    this.nodding = ["neck", "head"].map(joint);
  }

  /** The stance of a file that has one; null: it has none. @throws BundleError that of another body. */
  static of(piece: Piece, jointNames: readonly string[], expressions: number): Standing | null {
    return piece.tensors.has("body.idle") ? new Standing(piece, jointNames, expressions) : null;
  }

  /** Seconds since it is there. */
  get now(): number {
    return (performance.now() - this.began) / 1000;
  }

  /** Stands at a place, metres, from now on. */
  standAt(place: ArrayLike<number>): void {
    const at = 3 * this.jointNames.length;
    for (const axis of [0, 2]) this.row[at + axis] = place[axis];
  }

  /** Plans gestures for what is said from now on, of which so many seconds are heard already. */
  plan(phones: readonly Phone[], heard: number): void {
    this.arms.plan(phones, this.now - heard);
  }

  /** What is said is over. */
  retract(): void {
    this.arms.rest(this.now);
  }

  pose(): Pose {
    return this.poseAt(this.now);
  }

  /** The pose at a time, seconds since it is there. */
  poseAt(now: number): Pose {
    const { columns, idle, fingers, joints } = this, width = columns.length, count = idle.length / width;
    const at = (now * this.rate) % count, first = Math.floor(at) * width, next = ((Math.floor(at) + 1) % count) * width, share = at % 1;
    const row = this.row.slice(), place = 3 * this.jointNames.length, still = this.row.subarray(place, place + 3);
    for (let c = 0; c < width; ++c) {
      const value = (1 - share) * idle[first + c] + share * idle[next + c];
      // It sways about the place where it stands.
      if (columns[c] === place || columns[c] === place + 2) row[columns[c]] = still[columns[c] - place] + value - idle[c];
      else row[columns[c]] = value;
    }
    const pose = poseOfRow(row, this.jointNames.length, this.expressions), { state, beat } = this.arms.at(now);
    joints.forEach((joint, k) => pose.rotations.set(state.subarray(3 * k, 3 * k + 3), 3 * joint));
    for (const [joint, side, flexion] of fingers) {
      const k = 18 + 2 * side + flexion;
      pose.rotations[3 * joint + 2] += (side ? 1 : -1) * (state[k] - this.arms.lexicon.rest[k]);
    }
    return turned(pose, new Map(this.nodding.map((joint) => [joint, [0.5 * NODS * beat, 0, 0] as const])));
  }
}
