/** The renderer that a browser can run. */

import type { Renderer } from "./renderer.ts";
import { WebGL2Renderer } from "./webgl2.ts";

/** @param wanted "webgl2" or "webgpu": no other; else WebGPU where there is one. */
export async function makeRenderer(canvas: HTMLCanvasElement, wanted: string | null): Promise<Renderer> {
  if (wanted === "webgpu") throw new Error("not built yet");
  return new WebGL2Renderer(canvas);
}
