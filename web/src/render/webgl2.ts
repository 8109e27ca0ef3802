/** Gaussians by WebGL2: they come sorted, nearest first, and are blended into a target of half floats. */

import { RECORD } from "../avatar/deform.ts";
import { MATRICES } from "../light/irradiance.ts";
import type { Camera } from "./camera.ts";
import type { Picture, Renderer } from "./renderer.ts";
import { lit, RESOLVE_FRAGMENT, SPLAT_FRAGMENT, SPLAT_VERTEX, WHOLE_VERTEX } from "./webgl2_shaders.ts";

/** Attributes of a record: how many numbers each. */
const ATTRIBUTES = [4, 4, 2, 4];

/** Colours, and normals beside them where the picture is in another light. */
interface Programs {
  splats: WebGLProgram;
  resolve: WebGLProgram;
}

interface Resources {
  plain: Programs;
  /** Made when it is asked for. */
  lit: Programs | null;
  array: WebGLVertexArrayObject;
  buffer: WebGLBuffer;
  capacity: number;
  target: WebGLFramebuffer;
  texture: WebGLTexture;
  normals: WebGLTexture | null;
  width: number;
  height: number;
  /** Targets are of half floats: normals, which are negative too, need them. */
  fine: boolean;
}

/** A camera, and the lower left corner of the pixels that its picture goes to. */
export interface Window {
  camera: Camera;
  x: number;
  y: number;
}

type Shown = Pick<Picture, "count" | "background" | "blur" | "light">;

interface Timer {
  TIME_ELAPSED_EXT: number;
  GPU_DISJOINT_EXT: number;
}

export class WebGL2Renderer implements Renderer {
  readonly name = "WebGL2";
  readonly sorts = false;
  lost = false;
  milliseconds: number | null = null;
  readonly sorting = null;
  private readonly gl: WebGL2RenderingContext;
  private resources: Resources;
  private timer: Timer | null = null;
  private fence: WebGLSync | null = null;
  private query: WebGLQuery | null = null;

  /** @throws Error no WebGL2 here. */
  constructor(private readonly canvas: HTMLCanvasElement) {
    const gl = canvas.getContext("webgl2", { alpha: true, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("this browser has no WebGL2");
    this.gl = gl;
    this.resources = this.make();
    canvas.addEventListener("webglcontextlost", this.onlost);
    canvas.addEventListener("webglcontextrestored", this.onrestored);
  }

  private readonly onlost = (event: Event): void => {
    event.preventDefault();
    this.lost = true;
    this.query = null;
    this.fence = null;
  };

  private readonly onrestored = (): void => {
    this.resources = this.make();
    this.lost = false;
  };

  dispose(): void {
    const { gl, canvas, resources: { plain, lit, array, buffer, target, texture, normals } } = this;
    canvas.removeEventListener("webglcontextlost", this.onlost);
    canvas.removeEventListener("webglcontextrestored", this.onrestored);
    this.lost = true;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const { splats, resolve } of lit ? [plain, lit] : [plain]) [splats, resolve].forEach((program) => gl.deleteProgram(program));
    gl.deleteVertexArray(array);
    gl.deleteBuffer(buffer);
    gl.deleteFramebuffer(target);
    [texture, normals].forEach((one) => gl.deleteTexture(one));
    gl.deleteSync(this.fence);
    gl.deleteQuery(this.query);
    gl.flush();
  }

  get busy(): boolean {
    const { gl, fence } = this;
    return fence !== null && !this.lost && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED;
  }

  draw({ records, count, camera, background, blur, light }: Picture): void {
    if (this.lost) return;
    const { gl, canvas } = this, { width, height } = camera;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.upload(records, count);
    const timed = this.startTimer();
    this.paint({ camera, x: 0, y: 0 }, null, { count, background, blur, light });
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
  paint({ camera, x, y }: Window, framebuffer: WebGLFramebuffer | null, { count, background, blur, light }: Shown): void {
    const { gl, resources: own } = this, { width, height, view } = camera;
    const isLit = light !== null && own.fine;
    this.fit(width, height, isLit);
    const { splats, resolve } = isLit ? (own.lit ??= this.programs(lit)) : own.plain;
    gl.bindVertexArray(own.array);
    gl.bindFramebuffer(gl.FRAMEBUFFER, own.target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats);
    const at = (name: string) => gl.getUniformLocation(splats, name);
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
    gl.useProgram(resolve);
    gl.bindTexture(gl.TEXTURE_2D, own.texture);
    const to = (name: string) => gl.getUniformLocation(resolve, name);
    const [red, green, blue, covers = 1] = background;
    gl.uniform4f(to("background"), red, green, blue, covers);
    gl.uniform2i(to("corner"), x, y);
    if (isLit) {
      gl.activeTexture(gl.TEXTURE1);
      gl.bindTexture(gl.TEXTURE_2D, own.normals);
      gl.activeTexture(gl.TEXTURE0);
      gl.uniform1i(to("normals"), 1);
      gl.uniformMatrix4fv(to("light"), false, light.subarray(0, MATRICES / 2));
      gl.uniformMatrix4fv(to("captured"), false, light.subarray(MATRICES / 2));
    }
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
      plain: this.programs((shader) => shader), lit: null,
      array, buffer, capacity: 0,
      target: gl.createFramebuffer(), texture: gl.createTexture(), normals: null, width: 0, height: 0,
      fine: Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float")),
    };
  }

  private programs(kind: (shader: string) => string): Programs {
    return {
      splats: this.program(kind(SPLAT_VERTEX), kind(SPLAT_FRAGMENT)), resolve: this.program(WHOLE_VERTEX, kind(RESOLVE_FRAGMENT)),
    };
  }

  /** Gives the target the picture's size, and normals where it is lit. */
  private fit(width: number, height: number, lit: boolean): void {
    const { gl, resources: own } = this;
    if (own.width === width && own.height === height && lit === (own.normals !== null)) return;
    [own.width, own.height] = [width, height];
    gl.bindFramebuffer(gl.FRAMEBUFFER, own.target);
    this.attach(own.texture, gl.COLOR_ATTACHMENT0);
    if (!lit) gl.deleteTexture(own.normals);
    own.normals = lit ? (own.normals ?? gl.createTexture()) : null;
    // A texture that is gone must not stay attached.
    if (own.normals) this.attach(own.normals, gl.COLOR_ATTACHMENT1);
    else gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT1, gl.TEXTURE_2D, null, 0);
    gl.drawBuffers(lit ? [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1] : [gl.COLOR_ATTACHMENT0]);
  }

  /** Gives a texture the target's size, and the target that texture. */
  private attach(texture: WebGLTexture, at: number): void {
    const { gl, resources: { width, height, fine } } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, fine ? gl.RGBA16F : gl.RGBA8, width, height, 0, gl.RGBA,
      fine ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, at, gl.TEXTURE_2D, texture, 0);
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
    // Deleted with the program.
    for (const shader of gl.getAttachedShaders(program) ?? []) gl.deleteShader(shader);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`shaders of the player: ${gl.getProgramInfoLog(program)}`);
    }
    return program;
  }
}
