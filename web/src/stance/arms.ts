/** The arms of somebody who speaks and waits: gestures in time (`avatar.speech.gesture_planner.GesturePlanner`). */

import { asList, asNumber } from "../bundle/json.ts";
import type { Phone } from "../lips/visemes.ts";
import { multiply, quaternionFromRotvec } from "../math/rotations.ts";
import { beatsOf, type Beat, type Chance } from "./beats.ts";
import { Track } from "./track.ts";

/** Numbers of a state: rotation vectors of shoulder, elbow and wrist, left then right, and two flexions of the fingers a hand. */
const SIZE = 22, ARMS = 18;
/** Gestures that are remembered, so that others come first. */
const REMEMBERED = 200;
/** Of any of the numbers: they are seconds, frames a second and radians. */
const MOST = 1e3;

/** Times in seconds, angles in radians, as `gesture_planner.TIMING` explains them. */
export interface Numbers {
  fps: number;
  interval: number;
  strokes: [number, number];
  hold: [number, number];
  sizes: [number, number];
  speed: number;
  min_move: number;
  lead: number;
  min_preparation: number;
  max_wait: number;
  retraction: number;
  jitter: number;
  rise: number;
  fall: number;
  beat_elbow: number;
  beat_wrist: number;
  beat_shoulder: number;
  raised: number;
  memory: number;
}

/** @throws BundleError numbers that are none. */
export function numbersOf(about: Record<string, unknown>): Numbers {
  const read = (value: unknown, name: string) => asNumber(value, `gestures: ${name}`, 0, MOST), one = (name: string) => read(about[name], name);
  const pair = (name: string): [number, number] => [0, 1].map((k) => read(asList(about[name], name)[k], name)) as [number, number];
  const singles = "fps speed min_move lead min_preparation max_wait retraction jitter rise fall beat_elbow beat_wrist beat_shoulder raised memory".split(" ");
  return {
    ...Object.fromEntries(singles.map((name) => [name, one(name)])), interval: one("min_beat_interval"),
    strokes: pair("stroke_interval"), hold: pair("hold"), sizes: pair("sizes"),
  } as unknown as Numbers;
}

/** Gestures that a person can make: states, and between which of them (rest is the last) hands stay clear of the body. */
export interface Lexicon {
  rest: Float64Array;
  states: Float64Array;
  clear: ArrayLike<number>;
  count: number;
}

/** Chance by a small generator (mulberry32): the same seed, the same gestures. */
export class Dice implements Chance {
  constructor(private state = 1) {}

  private next(): number {
    this.state = (this.state + 0x6d2b79f5) | 0;
    let t = Math.imul(this.state ^ (this.state >>> 15), 1 | this.state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  }

  uniform(low: number, high: number): number {
    return low + (high - low) * this.next();
  }

  normal(): number {
    return Math.sqrt(-2 * Math.log(1 - this.next())) * Math.cos(2 * Math.PI * this.next());
  }

  shuffled(count: number): number[] {
    const out = Array.from({ length: count }, (_, k) => k);
    for (let k = count - 1; k > 0; --k) {
      const other = Math.floor(this.uniform(0, k + 1));
      [out[k], out[other]] = [out[other], out[k]];
    }
    return out;
  }
}

export class Arms {
  private readonly track: Track;
  /** Of each arm, whether it marks beats. */
  private readonly raised = new Track(new Float64Array(2));
  private beats: Beat[] = [];
  private recent: number[] = [];
  /** The gesture that the arms are at or go to; that of rest is `count`. */
  private gesture: number;

  constructor(readonly lexicon: Lexicon, private readonly numbers: Numbers, private readonly chance: Chance = new Dice()) {
    this.track = new Track(lexicon.rest);
    this.gesture = lexicon.count;
  }

  /** Plans the gestures of a speech that begins at a time, and lowers the hands behind it. */
  plan(phones: readonly Phone[], start: number): void {
    const { numbers, chance } = this, seconds = Math.max(0, ...phones.map(({ end }) => end));
    this.discardFrom(start);
    const rhythm = beatsOf(phones, numbers.interval, numbers.strokes, chance).map((one) => ({ ...one, time: one.time + start }));
    this.beats.push(...rhythm);
    const strokes = rhythm.filter(({ stroke }) => stroke).map(({ time }) => time);
    let free = start;
    strokes.forEach((time, k) => {
      const arrival = time - numbers.lead, held = time + chance.uniform(...numbers.hold), later = strokes[k + 1] ?? Infinity;
      if (arrival - free < numbers.min_preparation) return;
      this.stroke(arrival, free);
      free = held;
      // Hands are lowered where the next stroke is far away, and behind the last one.
      if (later - held <= numbers.max_wait) return;
      const end = Math.max(held, Math.min(start + seconds - 0.2, held + 0.8));
      this.retract(later === Infinity ? end : held);
      free = later - this.track.end > numbers.min_preparation ? this.track.end : held;
    });
  }

  /** The person waits from a time on. */
  rest(now: number): void {
    this.discardFrom(now);
    if (apart(this.track.target, this.lexicon.rest) >= 4 * this.numbers.jitter) this.retract(now + 0.15);
  }

  /** The state at a time with its beats in it, and the beat that the head shows, -1 to 1. */
  at(time: number): { state: Float64Array; beat: number } {
    const { numbers } = this, state = this.track.at(time).slice(), raised = this.raised.at(time), beat = this.beat(time);
    for (const [k, sign] of [[0, 1], [1, -1]]) {
      const share = beat * raised[k];
      state[9 * k] += numbers.beat_shoulder * share;
      state[9 * k + 4] += sign * numbers.beat_elbow * share;
      state[9 * k + 8] -= sign * numbers.beat_wrist * share;
    }
    return { state, beat };
  }

  private discardFrom(start: number): void {
    const { memory, rise } = this.numbers;
    for (const track of [this.track, this.raised]) {
      track.discardFrom(start);
      track.discardBefore(start - memory);
    }
    this.beats = this.beats.filter(({ time }) => start - memory < time && time < start + rise);
  }

  /** A dip before each beat, its weight at it, 0 behind it. */
  private beat(time: number): number {
    let sum = 0;
    for (const one of this.beats) {
      const before = (time - one.time) / this.numbers.rise, after = (time - one.time) / this.numbers.fall, s = before + 1;
      if (before > -1 && before <= 0) sum += one.weight * (s ** 3 * (10 - 15 * s + 6 * s * s) - 6 * s * s * (1 - s) ** 2);
      else if (after > 0 && after < 1) sum += one.weight * (1 - after * after) ** 3;
    }
    return Math.min(Math.max(sum, -1), 1);
  }

  /** Moves to another gesture, there by `arrival`, begun at `free` at the earliest. */
  private stroke(arrival: number, free: number): void {
    const { numbers, chance, track, lexicon: { rest, states, clear, count } } = this, now = track.at(free);
    const late = [...new Set([...this.recent].reverse())].slice(0, Math.floor((3 * count) / 4));
    for (const k of [...chance.shuffled(count).filter((one) => !late.includes(one)), ...late.reverse()]) {
      const size = chance.uniform(...numbers.sizes), target = rest.map((value, i) => value + size * (states[SIZE * k + i] - value));
      for (let i = 0; i < ARMS; ++i) target[i] += numbers.jitter * Math.min(Math.max(chance.normal(), -1.5), 1.5);
      const away = apart(now, target) / numbers.speed;
      if (away > 1.6 * (arrival - free) || !clear[this.gesture * (count + 1) + k]) continue;
      // As late as the speed allows: until then the hands rest or hold.
      const start = Math.max(free, arrival - Math.max(away, numbers.min_move));
      track.move(target, start, arrival);
      const far = [0, 1].map((arm) => Number(Math.hypot(...target.subarray(9 * arm, 9 * arm + 9).map((value, i) => value - rest[9 * arm + i])) > numbers.raised));
      this.raised.move(Float64Array.from(far), start, arrival);
      this.recent = [...this.recent.slice(-REMEMBERED), k];
      this.gesture = k;
      return;
    }
  }

  private retract(start: number): void {
    const { numbers, chance, lexicon: { rest, count } } = this, away = apart(this.track.target, rest);
    if (away < 1e-6) return;
    // People never come back to quite the same pose.
    const other = rest.map((value, i) => (i < ARMS ? value + 0.5 * numbers.jitter * Math.min(Math.max(chance.normal(), -1.5), 1.5) : value));
    this.track.move(away > numbers.raised ? other : rest, start, start + Math.max((numbers.retraction * away) / numbers.speed, 0.8));
    this.raised.move(new Float64Array(2), start, start + 0.4);
    this.gesture = count;
  }
}

/** The largest rotation of a joint between two states, radians; fingers do not count. */
function apart(one: Float64Array, other: Float64Array): number {
  let most = 0;
  for (let i = 0; i < ARMS; i += 3) {
    const [w, x, y, z] = quaternionFromRotvec(one, i), [a, b, c, d] = multiply([w, -x, -y, -z], quaternionFromRotvec(other, i));
    most = Math.max(most, 2 * Math.atan2(Math.hypot(b, c, d), Math.abs(a)));
  }
  return most;
}
