/** What a renderer of Gaussians is, whatever draws them. */

import type { Camera } from "./camera.ts";

export interface Picture {
  /** `RECORD` numbers a Gaussian; in the order of depth unless the renderer sorts. */
  records: Float32Array;
  count: number;
  camera: Camera;
  /** sRGB in [0, 1], and how much it covers of what is behind the canvas: 1 where left out. */
  background: readonly number[];
  /** Pixels squared. */
  blur: number;
  /** The least and the largest depth, metres. */
  depths: readonly [number, number];
  /** Another light than the capture's (`light/irradiance.ts`, `matrices`); null: that one. The records have normals then. */
  light: Float32Array | null;
}

export interface Renderer {
  readonly name: "WebGPU" | "WebGL2";
  readonly sorts: boolean;
  /** The device was lost, and is not back yet. */
  readonly lost: boolean;
  /** The last pictures are not finished: another one would have to wait. */
  readonly busy: boolean;
  draw(picture: Picture): void;
  /** (H, W, 4) bytes of the picture drawn last in this task, from the top. */
  pixels(): Promise<Uint8Array>;
  /** Milliseconds that the GPU took to draw a recent picture; null: not measured here. */
  readonly milliseconds: number | null;
  /** Those that it took before for projection and sort; null: it does not sort, or they are among the others. */
  readonly sorting: number | null;
  /** Gives back what it holds of the GPU, and clears the canvas, which another renderer may take. */
  dispose(): void;
  /** Loses context or device, as a driver that restarts does: for tests. It comes back by itself. */
  lose(): void;
}

