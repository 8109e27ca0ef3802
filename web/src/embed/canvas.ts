/** An avatar on a canvas of a page. */

import { Player } from "../player.ts";
import { makeRenderer } from "../render/choose.ts";
import type { Orbit } from "../render/camera.ts";
import { listen } from "../ui/gestures.ts";
import { Avatar, type AvatarOptions, type AvatarSettings } from "./avatar.ts";

/** What `set` changes beside what every avatar has. */
export interface CanvasSettings extends AvatarSettings {
  /** Any colour of CSS, or red, green, blue and opacity in [0, 1]; null: what is behind the canvas is seen. */
  background?: string | readonly number[] | null;
  /** All of the person, head and chest, or a camera of your own. */
  view?: "whole" | "chest" | Partial<Orbit>;
}

export interface CanvasOptions extends AvatarOptions, CanvasSettings {
  /** Pointers and wheel turn and move the camera, and keys where the canvas has the focus. Default: false. */
  controls?: boolean;
  /** Left out: WebGPU where a GPU runs it, else WebGL2. */
  renderer?: "webgpu" | "webgl2";
}

export class CanvasAvatar extends Avatar<Player> {
  constructor(readonly canvas: HTMLCanvasElement, options: CanvasOptions = {}) {
    const { background = null, view, controls, renderer = null } = options;
    super(async () => {
      const player = new Player(await makeRenderer(canvas, renderer), canvas, options.worker);
      player.background = colour(background);
      return player;
    }, options);
    const { signal } = this.disposing;
    this.started().then((player) => {
      if (!player) return;
      if (controls) steer(canvas, player, signal);
      const sized = new ResizeObserver(() => player.update());
      const seen = new IntersectionObserver((entries) => (player.unseen = !entries.at(-1)!.isIntersecting));
      [sized, seen].forEach((observer) => observer.observe(canvas));
      signal.addEventListener("abort", () => [sized, seen].forEach((observer) => observer.disconnect()));
    }).catch(() => {}); // `ready` says why
    this.on("ready", ({ name }) => {
      if (view) this.look(view);
      if (canvas.hasAttribute("aria-label")) return;
      canvas.setAttribute("aria-label", name);
      canvas.setAttribute("role", "img");
    });
  }

  override async set(settings: CanvasSettings): Promise<void> {
    const { background, view } = settings, wanted = background === undefined ? null : colour(background);
    if (view) await this.opened();
    if (!this.player && this.disposing.signal.aborted) return;
    if (view) this.look(view);
    await super.set(settings);
    if (!wanted || !this.player) return;
    this.player.background = wanted;
    this.player.update();
  }

  private look(view: NonNullable<CanvasSettings["view"]>): void {
    const player = this.player!;
    if (view === "chest") player.lookAtChest();
    else if (view === "whole") player.resetView();
    else {
      player.orbit = { ...player.orbit, ...view };
      player.update();
    }
  }
}

/**
 * Shows an avatar on a canvas, which may be of any size and change it.
 *
 * @returns at once; what is asked of it before `ready` is done then.
 */
export function createAvatar(canvas: HTMLCanvasElement, options: CanvasOptions = {}): CanvasAvatar {
  return new CanvasAvatar(canvas, options);
}

function steer(canvas: HTMLCanvasElement, player: Player, signal: AbortSignal): void {
  const { touchAction } = canvas.style, reached = canvas.hasAttribute("tabindex");
  canvas.style.touchAction = "none";
  if (!reached) canvas.tabIndex = 0;
  listen(canvas, player, canvas, signal);
  signal.addEventListener("abort", () => {
    canvas.style.touchAction = touchAction;
    if (!reached) canvas.removeAttribute("tabindex");
  });
}

/** sRGB and opacity. @throws Error no colour. */
function colour(given: string | readonly number[] | null): readonly number[] {
  if (given === null) return [0, 0, 0, 0];
  if (typeof given !== "string") {
    if (given.length === 3 || given.length === 4) return [...given, 1].slice(0, 4);
  } else if (CSS.supports("color", given)) {
    // A canvas knows every way that CSS writes colours in.
    const one = new OffscreenCanvas(1, 1).getContext("2d")!;
    one.fillStyle = given;
    one.fillRect(0, 0, 1, 1);
    return [...one.getImageData(0, 0, 1, 1).data].map((value) => value / 255);
  }
  throw new Error(`background: expected a colour of CSS, 3 or 4 numbers, or null, received ${JSON.stringify(given)}`);
}
