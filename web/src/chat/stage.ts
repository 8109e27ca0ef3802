/** Frames and sounds of the server on one clock: the audio's, as soon as a click has let it run. */

import type { Pose } from "../avatar/avatar.ts";
import { between } from "../avatar/motion.ts";
import type { Performer } from "../animator.ts";
import { Playing } from "../sound/playing.ts";
import { poseOfRow, type Frames, type Line } from "./wire.ts";

/** Seconds of frames behind the present that are kept; by which the clock may be off before it is set anew. */
const KEPT = 2, OFF = 0.25;
/** Seconds ahead of the present at which a sound can still begin. */
const AHEAD = 0.05;
/** Seconds by which sound and poses may part before they are brought together: a picture's half. */
const APART = 0.015;
/** Seconds after which it is looked again whether a line that is due has begun. */
const AGAIN = 0.01;
/** Seconds that a browser may take to wake its sound. */
const WAKES = 1;
/** Seconds in which a pose that is replaced goes over into the new one. */
const FADE = 0.2;

interface Sounding {
  line: Line;
  /** null: it cannot be heard here. */
  playing: Playing | null;
  /** The stage's time of its beginning and end. */
  start: number;
  end: number;
  /** Of what tells that it is heard. */
  timer: number;
}

export class Stage implements Performer {
  context: AudioContext | null = null;
  /** What everything that is heard passes, for who wants to look at it. */
  output: GainNode | null = null;
  /** Called when a line begins to be heard. */
  onbegin: (line: Line) => void = () => {};
  private readonly rows = new Map<number, Float32Array>();
  private last = -1;
  private fps = 30;
  private sounding: Sounding[] = [];
  /** The stage's time less the clock's. */
  private offset: number | null = null;
  private clock: () => number = () => performance.now() / 1000;
  /** The last pose that was asked for. */
  shown: Pose | null = null;
  /** The pose that is left, and when. */
  private left: { pose: Pose; at: number } | null = null;

  constructor(private readonly joints: number, private readonly expressions: number) {}

  /** The present, seconds of the server's time. */
  get now(): number {
    return this.clock() + (this.offset ?? 0);
  }

  get speaking(): boolean {
    return this.sounding.some(({ end }) => end > this.now);
  }

  /** Lets sound be heard; to be called by a click or a key. */
  unlock(): void {
    if (this.context) {
      if (this.context.state !== "running") void this.context.resume().catch(() => {}); // closed before it is awake
      return;
    }
    const context = new AudioContext();
    this.context = context;
    this.output = context.createGain();
    this.output.connect(context.destination);
    context.onstatechange = () => this.lead();
    void context.resume().catch(() => {}); // closed before it is awake
    this.lead();
  }

  /** Takes frames, and begins their sound when its time has come. */
  take(frames: Frames): void {
    const start = frames.first / frames.fps;
    this.fps = frames.fps;
    this.follow();
    const before = this.now;
    const off = this.offset === null || (!this.speaking && Math.abs(frames.now - this.now) > OFF);
    if (off) this.offset = frames.now - this.clock();
    if (frames.line) this.await(start);
    if (this.shown && this.now !== before) this.left = { pose: this.shown, at: this.now };
    for (let k = frames.first; k <= this.last; ++k) this.rows.delete(k);
    for (let k = 0; k < frames.count; ++k) this.rows.set(frames.first + k, frames.rows.subarray(k * frames.width, (k + 1) * frames.width));
    this.last = frames.first + frames.count - 1;
    for (const k of this.rows.keys()) if (k < (this.now - KEPT) * this.fps) this.rows.delete(k);
    if (!frames.line) return;
    const { line } = frames, { context } = this;
    // The first click's sound may not be awake yet; without a click it never is, and the line is shown alone.
    const patience = new Promise((resolve) => setTimeout(resolve, 1000 * WAKES));
    if (context?.state === "suspended") void Promise.race([context.resume().catch(() => {}), patience]).then(() => this.sound(line, start));
    else this.sound(line, start);
  }

  /** Forgets what came from a server that is gone. */
  reset(): void {
    this.hush();
    this.rows.clear();
    this.last = -1;
    this.offset = null;
  }

  /** Silence at once; what was to be said is not. */
  hush(): void {
    for (const { playing, timer } of this.sounding) {
      playing?.stop();
      clearTimeout(timer);
    }
    this.sounding = [];
  }

  /** The pose of what is heard now. */
  pose(): Pose | null {
    this.follow();
    const heard = this.now - (this.context?.outputLatency || 0);
    const at = Math.min(heard * this.fps, this.last), first = Math.floor(at);
    const low = this.row(first), high = this.row(first + 1) ?? low;
    if (!low || !high) return this.shown;
    const pose = at === first ? low : between(low, high, at - first);
    const share = this.left ? (heard - this.left.at) / FADE : 1;
    if (share >= 1) this.left = null;
    // The mouth is that of the sound at once.
    this.shown = this.left && share >= 0 ? { ...between(this.left.pose, pose, share * share * (3 - 2 * share)), expression: pose.expression } : pose;
    return this.shown;
  }

  private row(k: number): Pose | null {
    const row = this.rows.get(k);
    return row ? poseOfRow(row, this.joints, this.expressions) : null;
  }

  private sound(line: Line, start: number): void {
    const { context } = this, heard = context?.state === "running";
    if (heard) this.await(start);
    const one: Sounding = { line, playing: null, start, end: heard ? start + line.samples.length / line.rate : start, timer: 0 };
    this.sounding = [...this.sounding.filter(({ end }) => end > this.now - KEPT), one];
    if (heard) this.schedule(one);
    this.tell(one);
  }

  /** A page that was busy begins a sentence later rather than in its middle. */
  private await(start: number): void {
    if (!this.speaking) this.offset! -= Math.max(0, this.now + AHEAD - start);
  }

  /** Begins a line's sound when its time has come. */
  private schedule(one: Sounding): void {
    const { samples, rate } = one.line, context = this.context!;
    one.playing?.stop();
    one.playing = new Playing(context, [Float32Array.from(samples, (value) => value / 32768)], rate, this.output!);
    one.playing.start(Math.max(context.currentTime, one.start - this.offset!));
  }

  /** Tells that a line is heard, as soon as it is. */
  private tell(one: Sounding): void {
    this.follow();
    const { context } = this, left = one.start - this.now + (context?.outputLatency || 0);
    const silent = one.playing && context?.state === "running" && one.playing.begun() === null;
    if (left > 0 || silent) one.timer = window.setTimeout(() => this.tell(one), 1000 * Math.max(left, AGAIN));
    else this.onbegin(one.line);
  }

  /**
   * Brings the stage's time to that of the sound which is truly played.
   *
   * The audio's thread comes to a sound late where others have the cores, and then plays it from its first sample on. Poses
   * wait for it, and lines behind it begin as much later.
   */
  private follow(): void {
    const { context, offset } = this;
    if (context?.state !== "running" || offset === null) return;
    // The last line that has begun leads, or holds the time up until the next one does.
    const now = this.clock() + offset, going = this.sounding.filter(({ playing, end }) => playing && end > now);
    const begun = going.map(({ playing }) => playing!.begun()), count = 1 + begun.reduce((last: number, time, k) => (time === null ? last : k), -1);
    const due = going[count]?.start < now ? going[count] : null;
    const change = due ? due.start - now : count ? going[count - 1].start - begun[count - 1]! - offset : 0;
    if (!due && Math.abs(change) < APART) return;
    // The pose does not jump with the time.
    if (this.shown && !this.left && Math.abs(change) > APART) this.left = { pose: this.shown, at: now + change - (context.outputLatency || 0) };
    this.offset = offset + change;
    for (const one of going.slice(count)) if (one !== due) this.schedule(one);
  }

  /** The audio's clock leads as long as it runs; the stage's time goes on without a jump. */
  private lead(): void {
    const now = this.now, known = this.offset !== null, context = this.context!;
    this.clock = context.state === "running" ? () => context.currentTime : () => performance.now() / 1000;
    if (known) this.offset = now - this.clock();
  }
}
