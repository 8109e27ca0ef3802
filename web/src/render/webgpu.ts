/** Gaussians by WebGPU: projected, sorted by radix and drawn on the GPU, in any order that they come. */

import { RECORD } from "../avatar/deform.ts";
import { MATRICES } from "../light/irradiance.ts";
import type { Picture, Renderer } from "./renderer.ts";
import { asPainting, BLENDED, makePipelines, paintings, READ, type Painting, type Pipelines } from "./webgpu_pipelines.ts";
import { DIGITS, KEY_BITS, PASSES, SCENE_BYTES, TILE_KEYS } from "./webgpu_shaders.ts";

/** Pictures under way at once: one is drawn while the next is made ready. */
const MOST_PENDING = 2;
const TIMES = "timestamp-query", CLOCK_BYTES = 32;
const SPLAT_BYTES = 32, PROJECT_THREADS = 64, ROW_ALIGNMENT = 256;

/** What the number of Gaussians decides. */
interface Buffers {
  count: number;
  records: GPUBuffer;
  /** What splats are drawn of. */
  drawn: GPUBuffer[];
  project: GPUBindGroup;
  count_: GPUBindGroup[];
  scan: GPUBindGroup;
  scatter: GPUBindGroup[];
  plain: GPUBindGroup;
  /** Made when it is asked for. */
  lit: GPUBindGroup | null;
}

/** What tells the times of two passes: begin and end of each, nanoseconds. */
interface Clock {
  queries: GPUQuerySet;
  resolved: GPUBuffer;
  read: GPUBuffer;
  /** No answer is awaited. */
  free: boolean;
}

export class WebGPURenderer implements Renderer {
  readonly name = "WebGPU";
  readonly sorts = true;
  lost = false;
  milliseconds: number | null = null;
  sorting: number | null = null;
  private clock: Clock | null = null;
  private pending = 0;
  private disposed = false;
  private device!: GPUDevice;
  private pipelines!: Pipelines;
  private scene!: GPUBuffer;
  private background!: GPUBuffer;
  private lights!: GPUBuffer;
  private shifts: GPUBuffer[] = [];
  private buffers: Buffers | null = null;
  private target: GPUTexture | null = null;
  /** Of the last picture; null: it was in the capture's light. */
  private normals: GPUTexture | null = null;

  private constructor(private readonly canvas: HTMLCanvasElement, private readonly context: GPUCanvasContext) {}

  /** Makes one; null where the browser has no WebGPU, or, unless `anyDevice`, none but one that the CPU plays. */
  static async make(canvas: HTMLCanvasElement, anyDevice: boolean): Promise<WebGPURenderer | null> {
    const device = await freshDevice(anyDevice);
    if (!device || !(await canShow(device))) return null;
    // A canvas has one kind of context for ever: asked for once a device is there.
    const context = canvas.getContext("webgpu");
    if (!context) return null;
    const renderer = new WebGPURenderer(canvas, context);
    await renderer.start(device);
    return renderer;
  }

  get busy(): boolean {
    return this.pending >= MOST_PENDING;
  }

  draw({ records, count, camera, background, blur, depths, light }: Picture): void {
    if (this.lost) return;
    const { device, pipelines } = this, { width, height, view } = camera;
    this.fit(width, height, light !== null);
    if (light) device.queue.writeBuffer(this.lights, 0, light as Float32Array<ArrayBuffer>);
    const own = this.sized(records.length / RECORD), tiles = Math.max(1, Math.ceil(count / TILE_KEYS));
    const scene = new ArrayBuffer(SCENE_BYTES);
    new Float32Array(scene).set([...view, camera.fx, camera.fy, camera.cx, camera.cy, width, height, blur]);
    new Uint32Array(scene)[19] = count;
    new Float32Array(scene).set(depths, 20);
    new Uint32Array(scene)[22] = tiles;
    device.queue.writeBuffer(this.scene, 0, scene);
    device.queue.writeBuffer(this.background, 0, new Float32Array([...background, 1].slice(0, 4)));
    device.queue.writeBuffer(own.records, 0, records.buffer, records.byteOffset, 4 * RECORD * count);

    const encoder = device.createCommandEncoder();
    const clock = this.clock?.free ? this.clock : null;
    const timed = (first: number) => clock
      ? { timestampWrites: { querySet: clock.queries, beginningOfPassWriteIndex: first, endOfPassWriteIndex: first + 1 } }
      : {};
    const compute = encoder.beginComputePass(timed(0));
    const run = (pipeline: GPUComputePipeline, group: GPUBindGroup, workgroups: number) => {
      compute.setPipeline(pipeline);
      compute.setBindGroup(0, group);
      compute.dispatchWorkgroups(workgroups);
    };
    run(pipelines.project, own.project, Math.max(1, Math.ceil(count / PROJECT_THREADS)));
    for (let pass = 0; pass < PASSES; ++pass) {
      run(pipelines.count, own.count_[pass], tiles);
      run(pipelines.scan, own.scan, 1);
      run(pipelines.scatter, own.scatter[pass], tiles);
    }
    compute.end();
    const targets = light ? [this.target!, this.normals!] : [this.target!], painting = this.painting();
    const splats = encoder.beginRenderPass({
      colorAttachments: targets.map((target) => ({
        view: target.createView(), loadOp: "clear", storeOp: "store", clearValue: [0, 0, 0, 1],
      })),
      ...timed(2),
    });
    splats.setPipeline(painting.draw);
    splats.setBindGroup(0, light ? (own.lit ??= this.group(painting.draw, [...own.drawn, own.records])) : own.plain);
    if (count) splats.draw(4, count);
    splats.end();
    this.resolve(encoder, painting.resolve, this.context.getCurrentTexture().createView());
    if (clock) {
      encoder.resolveQuerySet(clock.queries, 0, 4, clock.resolved, 0);
      encoder.copyBufferToBuffer(clock.resolved, 0, clock.read, 0, CLOCK_BYTES);
    }
    const submitted = performance.now();
    device.queue.submit([encoder.finish()]);
    ++this.pending;
    if (clock) this.tell(clock);
    const done = () => {
      --this.pending;
      if (!this.clock) this.milliseconds = performance.now() - submitted;
    };
    device.queue.onSubmittedWorkDone().then(done, done);
  }

  /** Reads the times of a picture, once it is drawn. */
  private async tell(clock: Clock): Promise<void> {
    clock.free = false;
    // A device that is lost never answers: the next one has a clock of its own.
    if (!(await clock.read.mapAsync(GPUMapMode.READ).then(() => true, () => false))) return;
    const [began, sorted, drawing, drawn] = new BigInt64Array(clock.read.getMappedRange());
    this.sorting = Number(sorted - began) / 1e6;
    this.milliseconds = Number(drawn - drawing) / 1e6;
    clock.read.unmap();
    clock.free = true;
  }

  async pixels(): Promise<Uint8Array> {
    const { device, canvas: { width, height } } = this;
    const row = Math.ceil((4 * width) / ROW_ALIGNMENT) * ROW_ALIGNMENT;
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
    const texture = device.createTexture({ size: [width, height], format: READ, usage });
    const buffer = device.createBuffer({ size: row * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    const encoder = device.createCommandEncoder();
    this.resolve(encoder, this.painting().resolveToRead, texture.createView());
    encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow: row }, [width, height]);
    device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const padded = new Uint8Array(buffer.getMappedRange()), out = new Uint8Array(4 * width * height);
    for (let y = 0; y < height; ++y) out.set(padded.subarray(y * row, y * row + 4 * width), 4 * y * width);
    buffer.destroy();
    texture.destroy();
    return out;
  }

  dispose(): void {
    this.disposed = this.lost = true;
    this.context.unconfigure();
    this.device.destroy();
  }

  lose(): void {
    this.lost = true;
    this.device.destroy();
  }

  private resolve(encoder: GPUCommandEncoder, pipeline: GPURenderPipeline, view: GPUTextureView): void {
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: [
        { binding: 0, resource: this.target!.createView() },
        { binding: 1, resource: { buffer: this.background } },
        ...(this.normals
          ? [{ binding: 2, resource: this.normals.createView() }, { binding: 3, resource: { buffer: this.lights } }]
          : []),
      ],
    }));
    pass.draw(3);
    pass.end();
  }

  private async start(device: GPUDevice): Promise<void> {
    this.device = device;
    device.lost.then(() => this.recover());
    const format = navigator.gpu.getPreferredCanvasFormat();
    this.context.configure({ device, format, alphaMode: "premultiplied" });
    const uniform = (size: number) => device.createBuffer({ size, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    this.scene = uniform(SCENE_BYTES);
    this.background = uniform(16);
    this.lights = uniform(4 * MATRICES);
    const buffer = (usage: number) => device.createBuffer({ size: CLOCK_BYTES, usage: usage | GPUBufferUsage.COPY_DST });
    this.clock = !device.features.has(TIMES) ? null : {
      queries: device.createQuerySet({ type: "timestamp", count: 4 }), free: true,
      resolved: buffer(GPUBufferUsage.QUERY_RESOLVE | GPUBufferUsage.COPY_SRC), read: buffer(GPUBufferUsage.MAP_READ),
    };
    this.shifts = Array.from({ length: PASSES }, (_, pass) => {
      const buffer = uniform(16);
      device.queue.writeBuffer(buffer, 0, new Uint32Array([(pass * KEY_BITS) / PASSES]));
      return buffer;
    });
    this.buffers = null;
    this.target = this.normals = null;
    this.pipelines = await makePipelines(device, format);
    this.lost = false;
  }

  /** A new device in the place of one that is lost, as long as there is one to be had. */
  private async recover(): Promise<void> {
    this.lost = true;
    if (this.disposed) return;
    const device = await freshDevice();
    if (device) await this.start(device);
  }

  /** What the last picture is drawn by. */
  private painting(): Painting {
    const { device, pipelines } = this;
    if (!this.normals) return pipelines.plain;
    if (!pipelines.lit) {
      const made = paintings(device, navigator.gpu.getPreferredCanvasFormat(), true).map((it) => device.createRenderPipeline(it));
      pipelines.lit = asPainting(made);
    }
    return pipelines.lit;
  }

  private group(pipeline: GPUComputePipeline | GPURenderPipeline, buffers: GPUBuffer[]): GPUBindGroup {
    const entries = buffers.map((buffer, binding) => ({ binding, resource: { buffer } }));
    return this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
  }

  /** Gives the targets the picture's size; normals have one where it is lit. */
  private fit(width: number, height: number, lit: boolean): void {
    const { canvas } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const fits = this.target?.width === width && this.target.height === height;
    if (fits && lit === (this.normals !== null)) return;
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING;
    const make = () => this.device.createTexture({ size: [width, height], format: BLENDED, usage });
    this.target?.destroy();
    this.normals?.destroy();
    this.target = make();
    this.normals = lit ? make() : null;
  }

  /** Buffers for so many Gaussians. */
  private sized(count: number): Buffers {
    if (this.buffers?.count === count) return this.buffers;
    const { device, pipelines, scene } = this;
    const storage = (size: number) =>
      device.createBuffer({ size: Math.max(size, 16), usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST });
    const records = storage(4 * RECORD * count), splats = storage(SPLAT_BYTES * count);
    const keys = [storage(4 * count), storage(4 * count)], order = [storage(4 * count), storage(4 * count)];
    const counts = storage(4 * DIGITS * Math.max(1, Math.ceil(count / TILE_KEYS)));
    const group = (pipeline: GPUComputePipeline | GPURenderPipeline, ...buffers: GPUBuffer[]) => this.group(pipeline, buffers);
    const drawn = [scene, splats, order[0]];
    const passes = this.shifts.map((shift, pass) => ({ shift, from: pass % 2, to: 1 - (pass % 2) }));
    // An even number of passes ends where it began.
    this.buffers = {
      count, records, drawn, lit: null,
      project: group(pipelines.project, scene, records, splats, keys[0], order[0]),
      count_: passes.map(({ shift, from }) => group(pipelines.count, scene, shift, keys[from], counts)),
      scan: group(pipelines.scan, scene, counts),
      scatter: passes.map(({ shift, from, to }) =>
        group(pipelines.scatter, scene, shift, counts, keys[from], order[from], keys[to], order[to])),
      plain: group(pipelines.plain.draw, ...drawn),
    };
    return this.buffers;
  }
}

async function freshDevice(anyDevice = true): Promise<GPUDevice | null> {
  const adapter = await globalThis.navigator?.gpu?.requestAdapter({ powerPreference: "high-performance" });
  if (adapter && !anyDevice && isSoftware(adapter)) return null;
  return (await adapter?.requestDevice({ requiredFeatures: adapter.features.has(TIMES) ? [TIMES] : [] })) ?? null;
}

/** Whether the CPU plays this GPU: browsers say so in one of two places, or by the name of what plays it. */
function isSoftware(adapter: GPUAdapter): boolean {
  const { info } = adapter, { isFallbackAdapter } = adapter as { isFallbackAdapter?: boolean };
  const names = `${info?.vendor} ${info?.architecture} ${info?.device} ${info?.description}`;
  return Boolean(isFallbackAdapter ?? info?.isFallbackAdapter) || /swiftshader|llvmpipe|lavapipe|basic render/i.test(names);
}

/** Some browsers compute and cannot show it: their device is lost at the first picture. Tried where nothing is lost. */
async function canShow(device: GPUDevice): Promise<boolean> {
  const context = document.createElement("canvas").getContext("webgpu");
  if (!context) return false;
  context.configure({ device, format: navigator.gpu.getPreferredCanvasFormat() });
  const encoder = device.createCommandEncoder();
  const view = context.getCurrentTexture().createView();
  encoder.beginRenderPass({ colorAttachments: [{ view, loadOp: "clear", storeOp: "store" }] }).end();
  device.queue.submit([encoder.finish()]);
  const shown = device.queue.onSubmittedWorkDone().then(() => true, () => false);
  const lost = device.lost.then(() => false);
  const result = await Promise.race([shown, lost]);
  context.unconfigure();
  return result;
}
