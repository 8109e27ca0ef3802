/** What a renderer of Gaussians is, whatever draws them. */

import type { Camera } from "./camera.ts";

export interface Picture {
  /** `RECORD` numbers a Gaussian; in the order of depth unless the renderer sorts. */
  records: Float32Array;
  count: number;
  camera: Camera;
  /** sRGB in [0, 1]. */
  background: readonly [number, number, number];
  /** Pixels squared. */
  blur: number;
}

export interface Renderer {
  readonly name: "WebGPU" | "WebGL2";
  readonly sorts: boolean;
  /** The device was lost, and is not back yet. */
  readonly lost: boolean;
  draw(picture: Picture): void;
  /** (H, W, 4) bytes of the picture drawn last in this task, from the top. */
  pixels(): Promise<Uint8Array>;
  /** Milliseconds that the GPU took for a recent picture; null: not measured here. */
  readonly milliseconds: number | null;
  close(): void;
}

/** Alpha below which a Gaussian is not drawn, and above which it is cut: the rules of `avatar.render`. */
export const LEAST_ALPHA = 1 / 255;
export const MOST_ALPHA = 0.999;
