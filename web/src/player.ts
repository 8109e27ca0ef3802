/** The player without its controls: an avatar on a canvas, seen by a camera that turns around it. */

import { Animator, type Frame, type View } from "./animator.ts";
import { orbitCamera, type Camera, type Orbit } from "./render/camera.ts";
import type { Renderer } from "./render/renderer.ts";
import type { Summary } from "./worker/protocol.ts";

export type { Clock, Frame, Performer, View } from "./animator.ts";

/** sRGB and opacity of what is behind the avatar. */
export const BACKGROUND: readonly number[] = [0.071, 0.078, 0.094, 1];
/** Share of the picture's height that the person fills, and how wide she may reach, in her heights. */
const FILLED = 0.78, ARMS = 0.72;
/** Of the person's half height: where the camera looks above the middle; share of the distance that shows all of it. */
const CHEST = 0.42, NEARER = 0.62;

export class Player extends Animator {
  orbit: Orbit = { target: [0, 0, 0], distance: 3, azimuth: 0, elevation: 0 };
  /** A headset shows the avatar: the page's canvas rests. */
  immersed = false;
  /** The canvas is out of sight: it rests, and time goes on. */
  unseen = false;
  background = BACKGROUND;
  /** CSS pixels at the bottom that controls cover. */
  covered = 0;
  /** Called after another light was set. */
  onlight: () => void = () => {};
  private tick = 0;

  constructor(readonly renderer: Renderer, private readonly canvas: HTMLCanvasElement, script: string | URL | null = null) {
    super(script);
  }

  override async open(data: ArrayBuffer): Promise<Summary> {
    const summary = await super.open(data);
    this.resetView();
    if (!this.tick) this.tick = requestAnimationFrame(this.step);
    return summary;
  }

  override dispose(): void {
    cancelAnimationFrame(this.tick);
    super.dispose();
    this.renderer.dispose();
  }

  /** Puts the whole person into the picture, seen from before. */
  resetView(): void {
    if (!this.summary) return;
    const { middle, reach } = this.summary, { width, height, fx } = this.camera();
    const tall = (2 * reach * fx) / (FILLED * height), wide = (2 * ARMS * reach * fx) / width;
    this.orbit = { target: [...middle], distance: Math.max(tall, wide), azimuth: 0.35, elevation: 0.06 };
    this.update();
  }

  /** Shows head, chest and hands of who stands at a place; null: where the motion begins. */
  lookAtChest(place: ArrayLike<number> | null = null): void {
    this.resetView();
    const { middle, reach, motion } = this.summary!, target: Orbit["target"] = [...middle];
    if (place) for (const axis of [0, 2]) target[axis] += place[axis] - (motion?.translation[axis] ?? 0);
    target[1] += CHEST * reach;
    this.orbit = { target, distance: NEARER * this.orbit.distance, azimuth: 0.12, elevation: 0.03 };
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

  /** The orbit's camera, which follows the person, for the pixels that the canvas has. */
  camera(): Camera {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    const target = [...this.orbit.target] as Orbit["target"], begun = this.summary!.motion?.translation;
    const now = this.performer ? null : this.bodyAt();
    if (now) for (const axis of [0, 2]) target[axis] += now[axis] - (begun?.[axis] ?? 0);
    const camera = orbitCamera({ ...this.orbit, target }, width, height);
    return { ...camera, cy: camera.cy - 0.5 * this.covered * ratio };
  }

  override done(frame: Frame): void {
    // What leaves out the hidden, where the GPU sorts, is told by the GPU's own time.
    this.rates.draw = this.renderer.milliseconds;
    super.done(frame);
    if (this.renderer.sorting !== null) this.rates.sort = this.renderer.sorting;
  }

  protected override request(view: View, seconds: number | null): ReturnType<Animator["request"]> {
    this.sorted = this.immersed || !this.renderer.sorts;
    return super.request(view, seconds);
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
    if (this.renderer.busy || this.unseen) return;
    const frame = this.next(() => this.camera());
    if (frame) this.show(frame);
  };

  private show(frame: Frame, background = this.background): void {
    const { camera, count, depths } = frame, records = new Float32Array(frame.records);
    this.renderer.draw({ records, count, camera, background, depths, blur: this.summary!.blur, light: this.lightOf(frame) });
    this.done(frame);
  }
}
