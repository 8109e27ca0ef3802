/** An avatar in a worker: what it does, what time it is, and its Gaussians for a camera. It draws nothing itself. */

import type { Motion, Pose } from "./avatar/avatar.ts";
import { between, duration, poseAt, restPose, turned } from "./avatar/motion.ts";
import { RECORD } from "./avatar/deform.ts";
import { LONGEST_FOLLOWED } from "./cloth/driver.ts";
import { matrices, type Light } from "./light/irradiance.ts";
import type { LiveLips } from "./lips/lips.ts";
import type { Camera } from "./render/camera.ts";
import type { Reply, Request, Summary, Threads } from "./worker/protocol.ts";

declare const WORKER_SOURCE: string;

/** Metres a second below which clothes count as still, and seconds after which they are left alone. */
const STILL = 0.03, SETTLED = 6;
/** How many pictures the shown rates are means over. */
const MEMORY = 20;

/** Milliseconds by part, pictures a second. */
export interface Rates {
  fps: number;
  deform: number;
  cloth: number;
  sort: number;
  draw: number | null;
}

/** What one picture shows. */
export interface View {
  /** Seconds of the motion. */
  time: number;
  camera: Camera;
  /** sRGB and, where it is not 1, the share that it covers of what is behind the canvas. */
  background?: readonly number[];
  /** Of loose clothes since the last picture; left out: they start anew, null: they are not simulated. */
  seconds?: number | null;
}

/** What leads the motion's time in the place of the page's own clock. */
export interface Clock {
  /** The motion's time now, seconds, told of the time that the page is at; null: the page's own clock leads. */
  at(playing: boolean, time: number, speed: number): number | null;
}

/** Somebody who acts by herself, in the place of the motion. */
export interface Performer {
  /** The pose now; null: none is known yet. */
  pose(): Pose | null;
}

/** What moves the mouth on top of whatever else is done. */
export interface Mouth {
  readonly on: boolean;
  pose(pose: Pose): Pose;
}

export type Frame = Extract<Reply, { kind: "frame" }>;

export class Animator {
  summary: Summary | null = null;
  /** What is played; at first that of the bundle. */
  motion: Motion | null = null;
  /** Begins again at its end; a motion with a clock never does. */
  loop = true;
  /** Seconds into the motion. */
  time = 0;
  speed = 1;
  readonly hidden = new Set<number>();
  /** Joints turned by hand on top of the motion, joints held in its place, and expressions set by hand. */
  readonly turns = new Map<number, readonly [number, number, number]>();
  readonly held = new Map<number, readonly [number, number, number]>();
  readonly expressions = new Map<number, number>();
  /** Where the pelvis is held, metres; null: where the motion has it. */
  place: readonly [number, number, number] | null = null;
  /** How many have been drawn. */
  pictures = 0;
  readonly rates: Rates = { fps: 0, deform: 0, cloth: 0, sort: 0, draw: null };
  threads: Threads = { count: 1, helped: 0, lost: null };
  /** Loose clothes are simulated. */
  simulating = true;
  /** Another light than the capture's, and whether the avatar is shown in it; null: there is none. */
  light: Light | null = null;
  lit = true;
  /** Radians about the vertical by which it is turned. */
  lightTurn = 0;
  /** Gaussians are asked for in order of depth. */
  sorted = true;
  /** Of a sound that the motion goes with: it plays once, not in a loop. */
  clock: Clock | null = null;
  performer: Performer | null = null;
  /** What moves the mouth by live sound, null: nothing can; and what does by visemes. */
  lips: LiveLips | null = null;
  voice: Mouth | null = null;
  /** Called after each picture. */
  onpicture: () => void = () => {};
  /** Called when a motion that is not repeated has come to its end. */
  onend: () => void = () => {};
  onerror: (message: string) => void = () => {};

  private goes = true;
  protected still = false;
  protected changed = true;
  /** Seconds of the clothes since the last request. */
  protected elapsed = Infinity;
  /** Settled when the worker has nothing to do. */
  protected queue: Promise<unknown> = Promise.resolve();
  protected ready: Frame | null = null;
  protected disposed = false;
  private readonly worker: Worker;
  private readonly spare: ArrayBuffer[] = [];
  private answer: (reply: Reply) => void = () => {};
  private asked = 0;
  /** Seconds since something that is shown has changed by itself or by hand. */
  private quiet = 0;
  private before = 0;
  private lastDrawn = 0;
  /** The pose that another motion has replaced, when, and in how many milliseconds it goes over into the new one. */
  private left: { pose: Pose; at: number; fade: number } | null = null;

  /** @param script address of the worker's file, for pages whose policy allows no worker made of text; null: that text. */
  constructor(script: string | URL | null = null) {
    const url = script ?? URL.createObjectURL(new Blob([WORKER_SOURCE], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.worker.onmessage = (event: MessageEvent<Reply>) => {
      if (script === null) URL.revokeObjectURL(String(url));
      this.answer(event.data);
    };
    this.worker.onerror = (event) => this.answer({ kind: "failed", message: `the player failed: ${event.message ?? "its worker did not start"}` });
  }

  /** Opens a bundle. @throws Error what is wrong with it. */
  async open(data: ArrayBuffer): Promise<Summary> {
    const reply = await this.ask({ kind: "open", data }, [data]);
    if (reply.kind !== "opened") throw new Error(reply.kind === "failed" ? reply.message : "no avatar");
    this.summary = reply.summary;
    this.motion = reply.summary.motion;
    this.time = 0;
    this.elapsed = Infinity;
    this.place = this.left = null;
    for (const set of [this.hidden, this.turns, this.held, this.expressions]) set.clear();
    this.spare.length = 0;
    return reply.summary;
  }

  /** Ends the worker and its threads; nothing is answered any more. */
  dispose(): void {
    this.disposed = true;
    this.worker.terminate();
    this.lips?.dispose();
    this.ready = this.clock = this.performer = this.light = this.lips = this.voice = null;
    this.spare.length = 0;
    this.answer({ kind: "failed", message: "the avatar is disposed of" });
  }

  /** Plays another motion from its beginning, in which the pose goes over in so many seconds; null: that of the bundle. */
  begin(motion: Motion | null, fade: number): void {
    if (fade > 0 && this.summary) this.left = { pose: this.pose(this.time), at: performance.now(), fade: 1000 * fade };
    this.motion = motion ?? this.summary?.motion ?? null;
    this.time = 0;
    this.playing = true;
    this.update();
  }

  /** Lets somebody act in the motion's place, null: nobody; the pose goes over in so many seconds. */
  perform(performer: Performer | null, fade: number): void {
    if (performer === this.performer) return;
    if (fade > 0 && this.summary) this.left = { pose: this.pose(this.time), at: performance.now(), fade: 1000 * fade };
    this.performer = performer;
    this.update();
  }

  /** Something that is shown has changed. */
  update(): void {
    this.changed = true;
    this.quiet = 0;
  }

  /** Goes to a time of the motion. */
  seek(time: number): void {
    this.time = time;
    this.elapsed = Infinity;
    this.update();
  }

  /** The pose at a time, with what was set by hand. */
  pose(time: number): Pose {
    const { motion } = this, { jointNames, expressionNames } = this.summary!, acted = this.performer?.pose();
    let pose = acted ? { ...acted, expression: acted.expression.slice() } : motion ? poseAt(motion, time) : restPose(jointNames.length, expressionNames.length);
    for (const [joint, turn] of this.held) pose.rotations.set(turn, 3 * joint);
    if (this.place) pose.translation.set(this.place);
    if (this.left) {
      const share = (performance.now() - this.left.at) / this.left.fade;
      if (share < 1) pose = between(this.left.pose, pose, share * share * (3 - 2 * share));
      else this.left = null;
    }
    for (const mouth of [this.lips, this.voice]) if (mouth?.on) pose = mouth.pose(pose);
    for (const [k, value] of this.expressions) pose.expression[k] = value;
    return this.turns.size ? turned(pose, this.turns) : pose;
  }

  /** Where the pelvis is now, metres; null: at the origin of a body without a motion. */
  protected bodyAt(): ArrayLike<number> | null {
    const now = this.place ?? (this.motion && poseAt(this.motion, this.time).translation);
    if (!now || !this.left) return now;
    const share = Math.min((performance.now() - this.left.at) / this.left.fade, 1), from = this.left.pose.translation;
    return from.map((value, k) => value + share * share * (3 - 2 * share) * (now[k] - value));
  }

  get playing(): boolean {
    return this.goes;
  }

  /** Who stops it hears nothing more, also where the next picture is late. */
  set playing(goes: boolean) {
    this.goes = goes;
    if (!goes) this.clock?.at(false, this.time, this.speed);
  }

  get duration(): number {
    return this.motion && !this.performer ? duration(this.motion) : 0;
  }

  /** Lets time pass, to `now` in milliseconds. */
  advance(now: number): void {
    const passed = Math.min(0.25, (now - this.before) / 1000);
    this.before = now;
    this.quiet += passed;
    const led = this.duration > 0 ? (this.clock?.at(this.playing, this.time, this.speed) ?? null) : null;
    const next = led ?? this.time + passed * this.speed;
    this.elapsed += this.playing && led !== null ? led - this.time : passed * (this.playing ? this.speed : 1);
    if (this.playing && this.duration > 0) {
      const over = next >= this.duration, again = this.loop && !this.clock;
      if (!over) this.time = next;
      else if (this.clock) this.seek(0);
      else if (again) this.seek(next % this.duration);
      else this.time = this.duration;
      if (over && !again) this.playing = false;
      this.update();
      if (over && !again) this.onend();
    }
    if (this.performer || this.left || this.lips?.on || this.voice?.on) this.update();
  }

  /** What the worker has made ready, null: nothing new; the worker goes on, with what the camera sees, in the meantime. */
  next(camera: () => Camera): Frame | null {
    const frame = this.ready;
    this.ready = null;
    if (!this.asked && !this.changed && this.elapsed < Infinity) this.elapsed = 0;
    if (!this.asked && this.changed && !this.disposed) {
      this.changed = false;
      const seconds = !this.simulating ? null : this.elapsed < Infinity ? Math.min(this.elapsed, LONGEST_FOLLOWED) : Infinity;
      this.elapsed = this.simulating ? 0 : Infinity;
      this.ask(this.request({ time: this.time, camera: camera() }, seconds), []).then((reply) => {
        if (this.disposed) return;
        if (reply.kind === "frame") {
          this.ready = reply;
          // Clothes go on when nothing else does.
          if (reply.speed > STILL && this.quiet < SETTLED) this.changed = true;
        }
        else if (reply.kind === "failed") this.onerror(reply.message);
      });
    }
    return frame;
  }

  /** Takes back the memory of a frame that is drawn, and counts it. */
  done(frame: Frame): void {
    if (frame.records.byteLength === 4 * RECORD * this.summary!.count && this.spare.length < 2) this.spare.push(frame.records);
    const now = performance.now(), rates = this.rates;
    if (this.lastDrawn && now - this.lastDrawn < 2000) rates.fps = 1000 / mean(rates.fps && 1000 / rates.fps, now - this.lastDrawn);
    this.lastDrawn = now;
    rates.deform = mean(rates.deform, frame.deform);
    rates.cloth = mean(rates.cloth, frame.cloth);
    rates.sort = mean(rates.sort, frame.sort);
    this.threads = frame.threads;
    ++this.pictures;
    this.onpicture();
  }

  /** What a frame is to be lit by; null: it is shown as it was captured. */
  lightOf(frame: Frame): Float32Array | null {
    return frame.lit && this.light ? matrices(this.light, this.lightTurn) : null;
  }

  protected request({ time, camera }: View, seconds: number | null): Request {
    return {
      kind: "frame", pose: this.pose(time), camera, hidden: [...this.hidden], sorted: this.sorted, seconds,
      lit: this.lit && this.light !== null, records: this.spare.pop() ?? null,
    };
  }

  protected ask(request: Request, moved: Transferable[]): Promise<Reply> {
    if (request.kind === "frame" && request.records) moved.push(request.records);
    ++this.asked;
    const reply = this.queue.then(() => new Promise<Reply>((resolve) => {
      this.answer = resolve;
      if (this.disposed) resolve({ kind: "failed", message: "the avatar is disposed of" });
      else this.worker.postMessage(request, moved);
    }));
    this.queue = reply;
    return reply.finally(() => --this.asked);
  }
}

function mean(old: number, value: number): number {
  return old ? old + (value - old) / MEMORY : value;
}
