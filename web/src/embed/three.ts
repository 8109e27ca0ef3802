/** An avatar as an object of a three.js scene: what stands before it hides it, what stands behind is hidden. */

import {
  BufferAttribute, CustomBlending, DoubleSide, DynamicDrawUsage, GLSL3, InstancedBufferGeometry, InstancedInterleavedBuffer, InterleavedBufferAttribute,
  Matrix3, Matrix4, Mesh, OneFactor, OneMinusSrcAlphaFactor, ShaderMaterial, Vector2, Vector3, Vector4,
  type Camera as SceneCamera, type WebGLRenderer,
} from "three";
import { Animator } from "../animator.ts";
import { RECORD } from "../avatar/deform.ts";
import type { Camera } from "../render/camera.ts";
import { PROJECTION } from "../render/webgl2_shaders.ts";
import { Avatar, type AvatarOptions } from "./avatar.ts";

/** Attributes of a record: how many numbers each. */
const ATTRIBUTES = { place: 4, covariance0: 4, covariance1: 2, color: 4 };

const VERTEX = `
in vec4 place;
in vec4 covariance0;
in vec2 covariance1;
in vec4 color;
out vec2 at;
flat out vec4 paint;
flat out float reach;
${PROJECTION}
void main() {
  at = position.xy;
  Ellipse seen = ellipse(place, covariance0, covariance1, at);
  reach = seen.reach;
  paint = vec4(color.rgb, place.w);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  if (!seen.visible) return;
  // Where three.js puts the middle, so that depths are those of its other objects.
  vec4 middle = projectionMatrix * vec4(seen.middle.x, -seen.middle.y, -seen.middle.z, 1.0);
  vec2 there = vec2(2.0 * seen.pixel.x / size.x - 1.0, 1.0 - 2.0 * seen.pixel.y / size.y);
  gl_Position = vec4(there * middle.w, middle.z, middle.w);
}`;

const FRAGMENT = `
in vec2 at;
flat in vec4 paint;
flat in float reach;
out vec4 result;
void main() {
  float square = dot(at, at);
  if (square > 1.0) discard;
  float alpha = min(0.999, paint.a * exp(-reach * square));
  // On the canvas this gives the same colour back; on a target of linear light, that of its light.
  vec3 srgb = max(paint.rgb, 0.0);
  vec3 linear = mix(srgb / 12.92, pow((srgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, srgb));
  result = vec4(linearToOutputTexel(vec4(linear, 1.0)).rgb * alpha, alpha);
}`;

/** The avatar's feet stand at the origin of the object, and it looks along +z; metres. */
export class AvatarMesh extends Mesh<InstancedBufferGeometry, ShaderMaterial> {
  readonly avatar: Avatar;
  private buffer: InstancedInterleavedBuffer | null = null;
  /** How many of the buffer's are to be drawn once three.js has taken it to the GPU. */
  private filled = 0;
  private frame = -1;
  private complained = false;
  private readonly seen = new Matrix4();
  private readonly port = new Vector4();

  constructor(options: AvatarOptions = {}) {
    const material = new ShaderMaterial({
      vertexShader: VERTEX, fragmentShader: FRAGMENT, glslVersion: GLSL3, side: DoubleSide, depthWrite: false, transparent: true, toneMapped: false, premultipliedAlpha: true,
      blending: CustomBlending, blendSrc: OneFactor, blendDst: OneMinusSrcAlphaFactor,
      uniforms: {
        rotation: { value: new Matrix3() }, translation: { value: new Vector3() }, pinhole: { value: new Vector4() },
        size: { value: new Vector2() }, blur: { value: 0.3 },
      },
    });
    super(new InstancedBufferGeometry(), material);
    this.geometry.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 1, -1, 0, -1, 1, 0, 1, 1, 0]), 3));
    this.geometry.setIndex([0, 1, 2, 2, 1, 3]);
    this.geometry.instanceCount = 0;
    // Its place changes with the motion, which three.js does not know.
    this.frustumCulled = false;
    this.avatar = new Avatar<Animator>(({ worker }) => new Animator(worker), options);
    this.avatar.on("ready", ({ count, blur }) => this.hold(count, blur));
    this.onBeforeRender = (renderer, _, camera) => this.see(renderer, camera);
  }

  /** No triangle of it is one of the person's. */
  override raycast(): void {}

  dispose(): void {
    this.avatar.dispose();
    this.geometry.dispose();
    this.material.dispose();
    this.geometry.instanceCount = 0;
    this.removeFromParent();
  }

  private hold(count: number, blur: number): void {
    const { geometry } = this;
    // three.js keeps what it has of a geometry as large as that was.
    geometry.dispose();
    this.buffer = new InstancedInterleavedBuffer(new Float32Array(RECORD * count), RECORD).setUsage(DynamicDrawUsage);
    let offset = 0;
    for (const [name, size] of Object.entries(ATTRIBUTES)) {
      geometry.setAttribute(name, new InterleavedBufferAttribute(this.buffer, size, offset));
      offset += size;
    }
    this.filled = geometry.instanceCount = 0;
    this.material.uniforms.blur.value = blur;
  }

  /** Before it is drawn for a camera: time passes once a picture, and the Gaussians go to where they are seen. */
  private see(renderer: WebGLRenderer, camera: SceneCamera): void {
    const { player } = this.avatar, { geometry, material: { uniforms } } = this;
    if (!player || !this.buffer) return;
    const wrong = "isWebGPURenderer" in renderer ? "three's WebGLRenderer" : !("isPerspectiveCamera" in camera) ? "a perspective camera" : "";
    if (wrong) return this.complain(`the avatar's mesh: expected ${wrong}, received another one`);
    const { pinhole, rows, scale } = this.project(renderer, camera);
    const [a, b, c] = [rows.slice(0, 4), rows.slice(4, 8), rows.slice(8)];
    uniforms.rotation.value.set(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]);
    uniforms.translation.value.set(a[3], b[3], c[3]);
    uniforms.pinhole.value.set(pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy);
    uniforms.size.value.set(pinhole.width, pinhole.height);
    this.material.uniformsNeedUpdate = true;
    if (this.frame === renderer.info.render.frame) return;
    // What was filled in the last picture has come to the GPU before this one.
    this.frame = renderer.info.render.frame;
    geometry.instanceCount = this.filled;
    player.advance(performance.now());
    player.update();
    // The worker works in the avatar's own metres.
    const fresh = player.next(() => ({ ...pinhole, view: rows.map((value) => value / scale) }));
    if (!fresh) return;
    fill(this.buffer.array as Float32Array, new Float32Array(fresh.records), fresh.count);
    this.buffer.clearUpdateRanges();
    this.buffer.addUpdateRange(0, RECORD * fresh.count);
    this.buffer.needsUpdate = true;
    this.filled = fresh.count;
    player.done(fresh);
  }

  /** OpenCV's camera of a camera of three.js, over the avatar's own world, lengths in those of the scene. */
  private project(renderer: WebGLRenderer, camera: SceneCamera): { pinhole: Omit<Camera, "view">; rows: number[]; scale: number } {
    const { z: width, w: height } = renderer.getCurrentViewport(this.port), P = camera.projectionMatrix.elements;
    const m = this.seen.multiplyMatrices(camera.matrixWorldInverse, this.matrixWorld).elements, { middle, reach } = this.avatar.summary!;
    const feet = [middle[0], middle[1] - reach, middle[2]];
    const rows = [1, -1, -1].flatMap((sign, r) => {
      const row = [m[r], m[4 + r], m[8 + r]].map((value) => sign * value);
      return [...row, sign * m[12 + r] - row.reduce((sum, value, k) => sum + value * feet[k], 0)];
    });
    // As in a headset: x_ndc = P0 x / -z - P8, and y likewise.
    const pinhole = {
      fx: 0.5 * width * P[0], fy: 0.5 * height * P[5], cx: 0.5 * width * (1 - P[8]), cy: 0.5 * height * (1 + P[9]), width, height,
    };
    return { pinhole, rows, scale: Math.hypot(m[0], m[1], m[2]) };
  }

  private complain(message: string): void {
    if (!this.complained) console.error(message);
    this.complained = true;
  }
}

/** An avatar for `scene.add`. three's lights do not reach it: it is shown in the light of its capture. */
export function createAvatarMesh(options: AvatarOptions = {}): AvatarMesh {
  return new AvatarMesh(options);
}

/** Nearest first becomes farthest first, as three.js blends. */
function fill(out: Float32Array, records: Float32Array, count: number): void {
  for (let k = 0, to = 0; k < count; ++k) {
    for (let i = 0, from = RECORD * (count - 1 - k); i < RECORD; ++i) out[to++] = records[from++];
  }
}
