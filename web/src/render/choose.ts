/** The renderer that a browser can run. */

import type { Renderer } from "./renderer.ts";
import { WebGL2Renderer } from "./webgl2.ts";
import { WebGPURenderer } from "./webgpu.ts";

/**
 * @param wanted "webgl2" or "webgpu": no other; else WebGPU where a GPU runs it. Where the CPU plays the GPU, WebGL2 draws
 *   several times as fast.
 * @throws Error neither is here.
 */
export async function makeRenderer(canvas: HTMLCanvasElement, wanted: string | null): Promise<Renderer> {
  if (wanted !== "webgl2") {
    const renderer = await WebGPURenderer.make(canvas, wanted === "webgpu").catch(() => null);
    if (renderer) return renderer;
    if (wanted === "webgpu") throw new Error("it has no WebGPU, which was asked for");
  }
  return new WebGL2Renderer(canvas);
}
