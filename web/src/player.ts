/** The player without its controls: an avatar in a worker, a renderer, and what is to be shown. */

import type { Pose } from "./avatar/avatar.ts";
import { RECORD } from "./avatar/deform.ts";
import { duration, poseAt, restPose, turned } from "./avatar/motion.ts";
import { LONGEST_FOLLOWED } from "./cloth/driver.ts";
import type { LiveLips } from "./lips/lips.ts";
import { matrices, type Light } from "./light/irradiance.ts";
import { orbitCamera, type Camera, type Orbit } from "./render/camera.ts";
import type { Renderer } from "./render/renderer.ts";
import type { Reply, Request, Summary, Threads } from "./worker/protocol.ts";

declare const WORKER_SOURCE: string;

export const BACKGROUND: readonly [number, number, number] = [0.071, 0.078, 0.094];
/** CSS pixels at the bottom that the controls cover. */
const COVERED = 64;
/** Share of the picture's height that the person fills, and how wide she may reach, in her heights. */
const FILLED = 0.78, ARMS = 0.72;
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
  background?: readonly [number, number, number];
  /** Of loose clothes since the last picture; left out: they start anew, null: they are not simulated. */
  seconds?: number | null;
}

/** What leads the motion's time in the place of the page's own clock. */
export interface Clock {
  /** The motion's time now, seconds, told of the time that the page is at; null: the page's own clock leads. */
  at(playing: boolean, time: number, speed: number): number | null;
}

/** Somebody who acts by herself, in the place of the bundle's motion. */
export interface Performer {
  /** The pose now; null: none is known yet. */
  pose(): Pose | null;
}

export type Frame = Extract<Reply, { kind: "frame" }>;

export class Player {
  summary: Summary | null = null;
  playing = true;
  /** Seconds into the motion. */
  time = 0;
  speed = 1;
  orbit: Orbit = { target: [0, 0, 0], distance: 3, azimuth: 0, elevation: 0 };
  readonly hidden = new Set<number>();
  /** Joints turned by hand, and expressions set by hand. */
  readonly turns = new Map<number, readonly [number, number, number]>();
  readonly expressions = new Map<number, number>();
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
  /** A headset shows the avatar: the page's canvas rests. */
  immersed = false;
  /** Of a sound that the motion goes with: it plays once, not in a loop. */
  clock: Clock | null = null;
  performer: Performer | null = null;
  /** What moves the mouth by live sound; null: this page cannot. */
  lips: LiveLips | null = null;
  /** Called after each picture. */
  onpicture: () => void = () => {};
  /** Called after another light was set. */
  onlight: () => void = () => {};
  onerror: (message: string) => void = () => {};

  private readonly worker: Worker;
  private readonly spare: ArrayBuffer[] = [];
  private answer: (reply: Reply) => void = () => {};
  /** Settled when the worker has nothing to do. */
  private queue: Promise<unknown> = Promise.resolve();
  private asked = 0;
  private ready: Frame | null = null;
  private changed = true;
  /** Seconds since something that is shown has changed by itself or by hand, and of the clothes since the last request. */
  private quiet = 0;
  private elapsed = Infinity;
  private still = false;
  private before = 0;
  private lastDrawn = 0;
  private tick = 0;

  constructor(readonly renderer: Renderer, private readonly canvas: HTMLCanvasElement) {
    const url = URL.createObjectURL(new Blob([WORKER_SOURCE], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.worker.onmessage = (event: MessageEvent<Reply>) => this.answer(event.data);
    this.worker.onerror = (event) => this.answer({ kind: "failed", message: `the player failed: ${event.message}` });
  }

  /** Opens a bundle. @throws Error what is wrong with it. */
  async open(data: ArrayBuffer): Promise<Summary> {
    const reply = await this.ask({ kind: "open", data }, [data]);
    if (reply.kind !== "opened") throw new Error(reply.kind === "failed" ? reply.message : "no avatar");
    this.summary = reply.summary;
    this.time = 0;
    this.elapsed = Infinity;
    this.hidden.clear();
    this.turns.clear();
    this.expressions.clear();
    this.spare.length = 0;
    this.resetView();
    if (!this.tick) this.tick = requestAnimationFrame(this.step);
    return reply.summary;
  }

  /** Puts the whole person into the picture, seen from before. */
  resetView(): void {
    if (!this.summary) return;
    const { middle, reach } = this.summary, { width, height, fx } = this.camera();
    const tall = (2 * reach * fx) / (FILLED * height), wide = (2 * ARMS * reach * fx) / width;
    this.orbit = { target: [...middle], distance: Math.max(tall, wide), azimuth: 0.35, elevation: 0.06 };
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

  /** Draws one view, whatever else is going on, and returns its (H, W, 4) bytes from the top. */
  async picture(view: View): Promise<Uint8Array> {
    this.still = true;
    try {
      await this.queue;
      this.ready = null;
      const { seconds = Infinity } = view;
      const reply = await this.ask(this.request(view, seconds), []);
      if (reply.kind !== "frame") throw new Error(reply.kind === "failed" ? reply.message : "no picture");
      this.show(reply, view.background);
      return await this.renderer.pixels();
    } finally {
      this.still = false;
      this.elapsed = Infinity;
      this.update();
    }
  }

  /** The pose at a time, with what was set by hand. */
  pose(time: number): Pose {
    const { motion, jointNames, expressionNames } = this.summary!, acted = this.performer?.pose();
    let pose = acted ? { ...acted, expression: acted.expression.slice() } : motion ? poseAt(motion, time) : restPose(jointNames.length, expressionNames.length);
    if (this.lips?.on) pose = this.lips.pose(pose);
    for (const [k, value] of this.expressions) pose.expression[k] = value;
    return this.turns.size ? turned(pose, this.turns) : pose;
  }

  get duration(): number {
    return this.summary?.motion && !this.performer ? duration(this.summary.motion) : 0;
  }

  private readonly step = (now: number): void => {
    this.tick = requestAnimationFrame(this.step);
    if (this.immersed) return;
    this.advance(now);
    if (this.still || this.renderer.lost) {
      this.changed = true;
      return;
    }
    // Pictures that wait for a GPU that is behind would only be old ones.
    if (this.renderer.busy) return;
    const frame = this.next(() => this.camera());
    if (frame) this.show(frame);
  };

  /** Lets time pass, to `now` in milliseconds. */
  advance(now: number): void {
    const passed = Math.min(0.25, (now - this.before) / 1000);
    this.before = now;
    this.quiet += passed;
    const led = this.duration > 0 ? (this.clock?.at(this.playing, this.time, this.speed) ?? null) : null;
    const next = led ?? this.time + passed * this.speed;
    this.elapsed += this.playing && led !== null ? led - this.time : passed * (this.playing ? this.speed : 1);
    if (this.playing && this.duration > 0) {
      if (next < this.duration) this.time = next;
      else this.seek(this.clock ? 0 : next % this.duration);
      if (this.clock && next >= this.duration) this.playing = false;
      this.update();
    }
    if (this.performer || this.lips?.on) this.update();
  }

  /** What the worker has made ready, null: nothing new; the worker goes on, with what the camera sees, in the meantime. */
  next(camera: () => Camera): Frame | null {
    const frame = this.ready;
    this.ready = null;
    if (!this.asked && !this.changed && this.elapsed < Infinity) this.elapsed = 0;
    if (!this.asked && this.changed) {
      this.changed = false;
      const seconds = !this.simulating ? null : this.elapsed < Infinity ? Math.min(this.elapsed, LONGEST_FOLLOWED) : Infinity;
      this.elapsed = this.simulating ? 0 : Infinity;
      this.ask(this.request({ time: this.time, camera: camera() }, seconds), []).then((reply) => {
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
    const mean = (old: number, value: number) => (old ? old + (value - old) / MEMORY : value);
    if (this.lastDrawn && now - this.lastDrawn < 2000) rates.fps = 1000 / mean(rates.fps && 1000 / rates.fps, now - this.lastDrawn);
    this.lastDrawn = now;
    rates.deform = mean(rates.deform, frame.deform);
    rates.cloth = mean(rates.cloth, frame.cloth);
    // What leaves out the hidden, where the GPU sorts, is told by the GPU's own time.
    rates.sort = this.renderer.sorting ?? mean(rates.sort, frame.sort);
    rates.draw = this.renderer.milliseconds;
    this.threads = frame.threads;
    ++this.pictures;
    this.onpicture();
  }

  /** The orbit's camera, which follows the person, for the pixels that the page has. */
  camera(): Camera {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    const { motion } = this.summary!, target = [...this.orbit.target] as Orbit["target"];
    if (motion && !this.performer) {
      const now = poseAt(motion, this.time).translation;
      for (const axis of [0, 2]) target[axis] += now[axis] - motion.translation[axis];
    }
    const camera = orbitCamera({ ...this.orbit, target }, width, height);
    return { ...camera, cy: camera.cy - 0.5 * COVERED * ratio };
  }

  /** What a frame is to be lit by; null: it is shown as it was captured. */
  lightOf(frame: Frame): Float32Array | null {
    return frame.lit && this.light ? matrices(this.light, this.lightTurn) : null;
  }

  private request({ time, camera }: View, seconds: number | null): Request {
    const sorted = this.immersed || !this.renderer.sorts;
    return {
      kind: "frame", pose: this.pose(time), camera, hidden: [...this.hidden], sorted, seconds, lit: this.lit && this.light !== null,
      records: this.spare.pop() ?? null,
    };
  }

  private ask(request: Request, moved: Transferable[]): Promise<Reply> {
    if (request.kind === "frame" && request.records) moved.push(request.records);
    ++this.asked;
    const reply = this.queue.then(() => new Promise<Reply>((resolve) => {
      this.answer = resolve;
      this.worker.postMessage(request, moved);
    }));
    this.queue = reply;
    return reply.finally(() => --this.asked);
  }

  private show(frame: Frame, background = BACKGROUND): void {
    const { camera, count, depths } = frame, records = new Float32Array(frame.records);
    this.renderer.draw({ records, count, camera, background, depths, blur: this.summary!.blur, light: this.lightOf(frame) });
    this.done(frame);
  }
}
