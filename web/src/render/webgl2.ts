/** Gaussians by WebGL2: they come sorted, nearest first, and are blended into a target of half floats. */

import { RECORD } from "../avatar/deform.ts";
import type { Camera } from "./camera.ts";
import type { Picture, Renderer } from "./renderer.ts";
import { RESOLVE_FRAGMENT, SPLAT_FRAGMENT, SPLAT_VERTEX, WHOLE_VERTEX } from "./webgl2_shaders.ts";

/** Attributes of a record: how many numbers each. */
const ATTRIBUTES = [4, 4, 2, 4];

interface Resources {
  splats: WebGLProgram;
  resolve: WebGLProgram;
  array: WebGLVertexArrayObject;
  buffer: WebGLBuffer;
  capacity: number;
  target: WebGLFramebuffer;
  texture: WebGLTexture;
  width: number;
  height: number;
}

/** A camera, and the lower left corner of the pixels that its picture goes to. */
export interface Window {
  camera: Camera;
  x: number;
  y: number;
}

type Shown = Pick<Picture, "count" | "background" | "blur">;

interface Timer {
  TIME_ELAPSED_EXT: number;
  GPU_DISJOINT_EXT: number;
}

export class WebGL2Renderer implements Renderer {
  readonly name = "WebGL2";
  readonly sorts = false;
  lost = false;
  milliseconds: number | null = null;
  private readonly gl: WebGL2RenderingContext;
  private resources: Resources;
  private timer: Timer | null = null;
  private fence: WebGLSync | null = null;
  private query: WebGLQuery | null = null;

  /** @throws Error no WebGL2 here. */
  constructor(private readonly canvas: HTMLCanvasElement) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    this.resources = this.make();
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.lost = true;
      this.query = null;
      this.fence = null;
    });
    canvas.addEventListener("webglcontextrestored", () => {
      this.resources = this.make();
      this.lost = false;
    });
  }

  get busy(): boolean {
    const { gl, fence } = this;
    return fence !== null && !this.lost && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED;
  }

  draw({ records, count, camera, background, blur }: Picture): void {
    if (this.lost) return;
    const { gl, canvas } = this, { width, height } = camera;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.upload(records, count);
    const timed = this.startTimer();
    this.paint({ camera, x: 0, y: 0 }, null, { count, background, blur });
    if (timed) gl.endQuery(this.timer!.TIME_ELAPSED_EXT);
    gl.deleteSync(this.fence);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  /** Keeps Gaussians, nearest first, for `paint`. */
  upload(records: Float32Array, count: number): void {
    const { gl, resources: own } = this;
    gl.bindVertexArray(own.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, own.buffer);
    if (own.capacity < count) {
      own.capacity = records.length / RECORD;
      gl.bufferData(gl.ARRAY_BUFFER, 4 * records.length, gl.STREAM_DRAW);
    }
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, records, 0, count * RECORD);
    gl.bindVertexArray(null);
  }

  /** Draws what was uploaded last into a part of a framebuffer; null: the canvas. */
  paint({ camera, x, y }: Window, framebuffer: WebGLFramebuffer | null, { count, background, blur }: Shown): void {
    const { gl, resources: own } = this, { width, height, view } = camera;
    this.fit(width, height);
    gl.bindVertexArray(own.array);
    gl.bindFramebuffer(gl.FRAMEBUFFER, own.target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(own.splats);
    const at = (name: string) => gl.getUniformLocation(own.splats, name);
    // Rows of the view are columns here.
    const rotation = [0, 1, 2].flatMap((c) => [view[c], view[4 + c], view[8 + c]]);
    gl.uniformMatrix3fv(at("rotation"), false, rotation);
    gl.uniform3f(at("translation"), view[3], view[7], view[11]);
    gl.uniform4f(at("pinhole"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(at("size"), width, height);
    gl.uniform1f(at("blur"), blur);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);

    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(x, y, width, height);
    gl.disable(gl.BLEND);
    gl.useProgram(own.resolve);
    gl.bindTexture(gl.TEXTURE_2D, own.texture);
    gl.uniform3f(gl.getUniformLocation(own.resolve, "background"), ...background);
    gl.uniform2i(gl.getUniformLocation(own.resolve, "corner"), x, y);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
  }

  /** The context, once a headset may show what it draws. */
  async compatible(): Promise<WebGL2RenderingContext> {
    await (this.gl as WebGL2RenderingContext & { makeXRCompatible(): Promise<void> }).makeXRCompatible();
    return this.gl;
  }

  async pixels(): Promise<Uint8Array> {
    const { gl, canvas: { width, height } } = this;
    const upward = new Uint8Array(4 * width * height), out = new Uint8Array(upward.length);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
    const row = 4 * width;
    for (let y = 0; y < height; ++y) out.set(upward.subarray(y * row, (y + 1) * row), (height - 1 - y) * row);
    return out;
  }

  lose(): void {
    const loser = this.gl.getExtension("WEBGL_lose_context");
    this.lost = loser !== null;
    loser?.loseContext();
    setTimeout(() => loser?.restoreContext(), 100);
  }

  /** Asks for the time of this picture, if no older question is still open; says whether it did. */
  private startTimer(): boolean {
    const { gl, timer, query } = this;
    if (!timer) return false;
    if (query) {
      if (!gl.getQueryParameter(query, gl.QUERY_RESULT_AVAILABLE)) return false;
      const valid = !gl.getParameter(timer.GPU_DISJOINT_EXT);
      if (valid) this.milliseconds = Number(gl.getQueryParameter(query, gl.QUERY_RESULT)) / 1e6;
      gl.deleteQuery(query);
    }
    this.query = gl.createQuery();
    if (this.query) gl.beginQuery(timer.TIME_ELAPSED_EXT, this.query);
    return this.query !== null;
  }

  private make(): Resources {
    const { gl } = this;
    this.timer = gl.getExtension("EXT_disjoint_timer_query_webgl2");
    this.query = null;
    const array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    let offset = 0;
    ATTRIBUTES.forEach((count, location) => {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, count, gl.FLOAT, false, 4 * RECORD, offset);
      gl.vertexAttribDivisor(location, 1);
      offset += 4 * count;
    });
    gl.bindVertexArray(null);
    return {
      splats: this.program(SPLAT_VERTEX, SPLAT_FRAGMENT),
      resolve: this.program(WHOLE_VERTEX, RESOLVE_FRAGMENT),
      array, buffer, capacity: 0,
      target: gl.createFramebuffer(), texture: gl.createTexture(), width: 0, height: 0,
    };
  }

  /** Gives the target the picture's size. */
  private fit(width: number, height: number): void {
    const { gl, resources: own } = this;
    if (own.width === width && own.height === height) return;
    [own.width, own.height] = [width, height];
    const fine = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    gl.bindTexture(gl.TEXTURE_2D, own.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, fine ? gl.RGBA16F : gl.RGBA8, width, height, 0, gl.RGBA,
      fine ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, own.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, own.texture, 0);
  }

  private program(vertex: string, fragment: string): WebGLProgram {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]] as const) {
      const shader = gl.createShader(kind)!;
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`shaders of the player: ${gl.getProgramInfoLog(program)}`);
    }
    return program;
  }
}
