/** Pipelines of the WebGPU renderer. */

import { COUNT, draw, PROJECT, resolve, SCAN, SCATTER } from "./webgpu_shaders.ts";

export const BLENDED: GPUTextureFormat = "rgba16float", READ: GPUTextureFormat = "rgba8unorm";

/** What draws and shows; with another light normals are drawn, too. */
export interface Painting {
  draw: GPURenderPipeline;
  resolve: GPURenderPipeline;
  resolveToRead: GPURenderPipeline;
}

export interface Pipelines {
  project: GPUComputePipeline;
  count: GPUComputePipeline;
  scan: GPUComputePipeline;
  scatter: GPUComputePipeline;
  plain: Painting;
  /** Made when it is asked for. */
  lit: Painting | null;
}

/** Makes those of pictures in the capture's light. */
export async function makePipelines(device: GPUDevice, format: GPUTextureFormat): Promise<Pipelines> {
  const compute = (code: string, entryPoint: string) =>
    device.createComputePipelineAsync({ layout: "auto", compute: { module: device.createShaderModule({ code }), entryPoint } });
  const [[project, count, scan, scatter], painting] = await Promise.all([
    Promise.all([compute(PROJECT, "project"), compute(COUNT, "count"), compute(SCAN, "scan"), compute(SCATTER, "scatter")]),
    Promise.all(paintings(device, format, false).map((it) => device.createRenderPipelineAsync(it))),
  ]);
  return { project, count, scan, scatter, plain: asPainting(painting), lit: null };
}

export function asPainting([draw, resolve, resolveToRead]: GPURenderPipeline[]): Painting {
  return { draw, resolve, resolveToRead };
}

/** What draws splats, shows them on the canvas, and shows them to be read. */
export function paintings(device: GPUDevice, format: GPUTextureFormat, lit: boolean): GPURenderPipelineDescriptor[] {
  const painting = (
    code: string, entries: [string, string], targets: GPUColorTargetState[], topology: GPUPrimitiveTopology,
  ): GPURenderPipelineDescriptor => {
    const module = device.createShaderModule({ code });
    return {
      layout: "auto", primitive: { topology },
      vertex: { module, entryPoint: entries[0] }, fragment: { module, entryPoint: entries[1], targets },
    };
  };
  const under: GPUBlendState = {
    color: { srcFactor: "dst-alpha", dstFactor: "one", operation: "add" },
    alpha: { srcFactor: "zero", dstFactor: "one-minus-src-alpha", operation: "add" },
  };
  const blended = new Array(lit ? 2 : 1).fill({ format: BLENDED, blend: under });
  return [
    painting(draw(lit), ["corner", "blend"], blended, "triangle-strip"),
    painting(resolve(lit), ["whole", "resolve"], [{ format }], "triangle-list"),
    painting(resolve(lit), ["whole", "resolve"], [{ format: READ }], "triangle-list"),
  ];
}
