/** Frames and sounds of the server on one clock: the audio's, as soon as a click has let it run. */

import type { Pose } from "../avatar/avatar.ts";
import { between } from "../avatar/motion.ts";
import type { Performer } from "../animator.ts";
import { poseOfRow, type Frames, type Line } from "./wire.ts";

/** Seconds of frames behind the present that are kept; by which the clock may be off before it is set anew. */
const KEPT = 2, OFF = 0.25;
/** Seconds ahead of the present at which a sound can still begin. */
const AHEAD = 0.05;
/** Seconds that a browser may take to wake its sound. */
const WAKES = 1;
/** Seconds in which a pose that is replaced goes over into the new one. */
const FADE = 0.2;

interface Sounding {
  line: Line;
  /** null: it cannot be heard here. */
  source: AudioBufferSourceNode | null;
  /** The stage's time of its beginning and end. */
  start: number;
  end: number;
  /** Of what tells that it has begun. */
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
    const before = this.now;
    const off = this.offset === null || (!this.speaking && Math.abs(frames.now - this.now) > OFF);
    if (off) this.offset = frames.now - this.clock();
    // A page that was busy begins a sentence later rather than in its middle.
    if (frames.line && !this.speaking) this.offset! -= Math.max(0, this.now + AHEAD - start);
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
    for (const { source, timer } of this.sounding) {
      source?.stop();
      clearTimeout(timer);
    }
    this.sounding = [];
  }

  /** The pose of what is heard now. */
  pose(): Pose | null {
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
    const { context, output } = this, wait = start - this.now + (context?.outputLatency || 0);
    const timer = window.setTimeout(() => this.onbegin(line), 1000 * Math.max(0, wait));
    const one: Sounding = { line, source: null, start, end: start, timer };
    this.sounding = [...this.sounding.filter(({ end }) => end > this.now - KEPT), one];
    if (!context || !output || context.state !== "running") return;
    one.end = start + line.samples.length / line.rate;
    const buffer = context.createBuffer(1, Math.max(line.samples.length, 1), line.rate);
    buffer.copyToChannel(Float32Array.from(line.samples, (value) => value / 32768), 0);
    one.source = context.createBufferSource();
    one.source.buffer = buffer;
    one.source.connect(output);
    one.source.start(context.currentTime + Math.max(0, start - this.now), Math.max(0, this.now - start));
  }

  /** The audio's clock leads as long as it runs; the stage's time goes on without a jump. */
  private lead(): void {
    const now = this.now, known = this.offset !== null, context = this.context!;
    this.clock = context.state === "running" ? () => context.currentTime : () => performance.now() / 1000;
    if (known) this.offset = now - this.clock();
  }
}
