/** Projection, sort and blending as `docs/rendering.md` says, in WGSL. */

/** Keys that a workgroup of the sort takes, and the digits of a pass. */
export const THREADS = 128, KEYS_PER_THREAD = 8, DIGITS = 16;
export const TILE_KEYS = THREADS * KEYS_PER_THREAD;
/** Bits of a key, and passes over them. */
export const KEY_BITS = 16, PASSES = 4;
/** Bytes of `Scene`. */
export const SCENE_BYTES = 96;

const SCENE = /* wgsl */ `
struct Scene {
  row0: vec4f,
  row1: vec4f,
  row2: vec4f,
  pinhole: vec4f,
  size: vec2f,
  blur: f32,
  count: u32,
  depths: vec2f,
  tiles: u32,
  unused: u32,
}
struct Splat {
  center: vec2f,
  longer: vec2f,
  shorter: vec2f,
  color: vec2u,
}
`;

/** One Gaussian a thread: its ellipse where alpha reaches 1/255, and its key. What is not seen has no size. */
export const PROJECT = /* wgsl */ `${SCENE}
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<storage, read> records: array<f32>;
@group(0) @binding(2) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> order: array<u32>;

@compute @workgroup_size(64)
fn project(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= scene.count) { return; }
  let at = 14u * i;
  let mean = vec4f(records[at], records[at + 1u], records[at + 2u], 1.0);
  let opacity = records[at + 3u];
  let p = vec3f(dot(scene.row0, mean), dot(scene.row1, mean), dot(scene.row2, mean));
  let reach = log(255.0 * opacity);
  order[i] = i;
  let span = max(scene.depths.y - scene.depths.x, 1e-6);
  keys[i] = u32(clamp((p.z - scene.depths.x) / span, 0.0, 1.0) * 65535.0);
  splats[i] = Splat(vec2f(0.0), vec2f(0.0), vec2f(0.0), vec2u(0u));
  if (!(p.z >= 0.01) || !(reach > 0.0)) { return; }

  let focal = scene.pinhole.xy;
  let middle = scene.pinhole.zw;
  // The derivative is taken inside the picture, widened by 15 % on every side.
  let low = (-0.15 * scene.size - middle) / focal;
  let high = (1.15 * scene.size - middle) / focal;
  let slope = clamp(p.xy / p.z, low, high);
  let jx = (focal.x / p.z) * (scene.row0.xyz - slope.x * scene.row2.xyz);
  let jy = (focal.y / p.z) * (scene.row1.xyz - slope.y * scene.row2.xyz);
  let xx = records[at + 4u];
  let xy = records[at + 5u];
  let xz = records[at + 6u];
  let yy = records[at + 7u];
  let yz = records[at + 8u];
  let zz = records[at + 9u];
  let v = mat3x3f(xx, xy, xz, xy, yy, yz, xz, yz, zz);
  let vx = v * jx;
  let vy = v * jy;
  let a = dot(jx, vx) + scene.blur;
  let b = dot(jx, vy);
  let c = dot(jy, vy) + scene.blur;
  let mean2 = 0.5 * (a + c);
  let spread = sqrt(0.25 * (a - c) * (a - c) + b * b);
  let angle = 0.5 * atan2(2.0 * b, a - c);
  let along = vec2f(cos(angle), sin(angle));
  // Half axes where sigma = reach: sqrt(2 reach lambda).
  let longer = sqrt(2.0 * reach * (mean2 + spread)) * along;
  let shorter = sqrt(2.0 * reach * max(mean2 - spread, 1e-9)) * vec2f(-along.y, along.x);
  let color = vec4f(records[at + 10u], records[at + 11u], records[at + 12u], opacity);
  let packed = vec2u(pack2x16float(color.rg), pack2x16float(color.ba));
  splats[i] = Splat(focal * p.xy / p.z + middle, longer, shorter, packed);
}
`;

/** How many keys of every tile have each digit; then where in the sorted list each tile's keys of a digit begin. */
export const COUNT = /* wgsl */ `${SCENE}
struct Pass { shift: u32 }
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<uniform> step: Pass;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
var<workgroup> found: array<atomic<u32>, ${DIGITS}>;

@compute @workgroup_size(${THREADS})
fn count(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (thread < ${DIGITS}u) { atomicStore(&found[thread], 0u); }
  workgroupBarrier();
  let first = tile.x * ${TILE_KEYS}u + thread * ${KEYS_PER_THREAD}u;
  for (var k = first; k < min(first + ${KEYS_PER_THREAD}u, scene.count); k++) {
    atomicAdd(&found[(keys[k] >> step.shift) & ${DIGITS - 1}u], 1u);
  }
  workgroupBarrier();
  if (thread < ${DIGITS}u) { counts[thread * scene.tiles + tile.x] = atomicLoad(&found[thread]); }
}
`;

export const SCAN = /* wgsl */ `${SCENE}
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<storage, read_write> counts: array<u32>;
const WIDE = 256u;
var<workgroup> sums: array<u32, WIDE>;

@compute @workgroup_size(WIDE)
fn scan(@builtin(local_invocation_index) thread: u32) {
  let whole = ${DIGITS}u * scene.tiles;
  let share = (whole + WIDE - 1u) / WIDE;
  let first = thread * share;
  let last = min(first + share, whole);
  var sum = 0u;
  for (var k = first; k < last; k++) { sum += counts[k]; }
  sums[thread] = sum;
  workgroupBarrier();
  for (var step = 1u; step < WIDE; step *= 2u) {
    var before = 0u;
    if (thread >= step) { before = sums[thread - step]; }
    workgroupBarrier();
    sums[thread] += before;
    workgroupBarrier();
  }
  var start = sums[thread] - sum;
  for (var k = first; k < last; k++) {
    let count = counts[k];
    counts[k] = start;
    start += count;
  }
}
`;

/** Puts every key where its digit, its tile and its place in the tile say: a stable pass. */
export const SCATTER = /* wgsl */ `${SCENE}
struct Pass { shift: u32 }
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<uniform> step: Pass;
@group(0) @binding(2) var<storage, read> starts: array<u32>;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read_write> newKeys: array<u32>;
@group(0) @binding(6) var<storage, read_write> newOrder: array<u32>;
// Of every digit, what every thread has of it: then where the thread's first of it goes.
var<workgroup> places: array<u32, ${DIGITS * THREADS}>;

@compute @workgroup_size(${THREADS})
fn scatter(@builtin(workgroup_id) tile: vec3u, @builtin(local_invocation_index) thread: u32) {
  for (var d = 0u; d < ${DIGITS}u; d++) { places[d * ${THREADS}u + thread] = 0u; }
  let first = tile.x * ${TILE_KEYS}u + thread * ${KEYS_PER_THREAD}u;
  let last = min(first + ${KEYS_PER_THREAD}u, scene.count);
  for (var k = first; k < last; k++) {
    places[((keys[k] >> step.shift) & ${DIGITS - 1}u) * ${THREADS}u + thread] += 1u;
  }
  workgroupBarrier();
  if (thread < ${DIGITS}u) {
    var start = starts[thread * scene.tiles + tile.x];
    for (var t = 0u; t < ${THREADS}u; t++) {
      let at = thread * ${THREADS}u + t;
      let count = places[at];
      places[at] = start;
      start += count;
    }
  }
  workgroupBarrier();
  for (var k = first; k < last; k++) {
    let key = keys[k];
    let at = ((key >> step.shift) & ${DIGITS - 1}u) * ${THREADS}u + thread;
    let to = places[at];
    places[at] = to + 1u;
    newKeys[to] = key;
    newOrder[to] = order[k];
  }
}
`;

/**
 * One splat an instance, nearest first; the target's alpha is what still shines through.
 *
 * @param lit normals are blended beside colours, for pictures in another light.
 */
export const draw = (lit: boolean) => /* wgsl */ `${SCENE}
@group(0) @binding(0) var<uniform> scene: Scene;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
${lit ? UNFOLD : ""}
struct Corner {
  @builtin(position) position: vec4f,
  @location(0) at: vec2f,
  @location(1) @interpolate(flat) paint: vec4f,
  ${lit ? "@location(2) @interpolate(flat) facing: vec3f," : ""}
}

@vertex
fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
  let splat = splats[order[instance]];
  let at = vec2f(f32(vertex & 1u), f32(vertex >> 1u)) * 2.0 - 1.0;
  let pixel = splat.center + at.x * splat.longer + at.y * splat.shorter;
  let paint = vec4f(unpack2x16float(splat.color.x), unpack2x16float(splat.color.y));
  let position = vec4f(2.0 * pixel.x / scene.size.x - 1.0, 1.0 - 2.0 * pixel.y / scene.size.y, 0.0, 1.0);
  return Corner(position, at, paint${lit ? ", unfolded(records[14u * order[instance] + 13u])" : ""});
}

struct Blended {
  @location(0) color: vec4f,
  ${lit ? "@location(1) normal: vec4f," : ""}
}

@fragment
fn blend(in: Corner) -> Blended {
  let square = dot(in.at, in.at);
  if (square > 1.0) { discard; }
  let alpha = min(0.999, in.paint.a * exp(-log(255.0 * in.paint.a) * square));
  return Blended(vec4f(in.paint.rgb * alpha, alpha)${lit ? ", vec4f(in.facing * alpha, alpha)" : ""});
}
`;

/** What `web/splats.cpp` has folded. */
const UNFOLD = /* wgsl */ `
@group(0) @binding(3) var<storage, read> records: array<f32>;

fn unfolded(code: f32) -> vec3f {
  if (code == 0.0) { return vec3f(0.0); }
  let high = floor(code / 4096.0);
  let at = (vec2f(high, code - 4096.0 * high) - 2048.0) / 2047.0;
  let z = 1.0 - abs(at.x) - abs(at.y);
  let over = max(-z, 0.0);
  return normalize(vec3f(at - select(vec2f(over), vec2f(-over), at < vec2f(0.0)), z));
}
`;

/** The picture on its background; `isLit`: in another light. */
export const resolve = (isLit: boolean) => /* wgsl */ `
@group(0) @binding(0) var blended: texture_2d<f32>;
@group(0) @binding(1) var<uniform> background: vec4f;
${isLit ? RELIGHT : ""}
@vertex
fn whole(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(4.0 * f32(vertex & 1u) - 1.0, 4.0 * f32(vertex >> 1u) - 1.0, 0.0, 1.0);
}

@fragment
fn resolve(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let value = textureLoad(blended, vec2i(at.xy), 0);
  ${isLit ? "let rgb = shown(value, textureLoad(normals, vec2i(at.xy), 0).xyz);" : "let rgb = value.rgb;"}
  // Premultiplied, as browsers want what is seen through.
  return vec4f(rgb + value.a * background.a * background.rgb, 1.0 - value.a * (1.0 - background.a));
}
`;

/** As `smplxpp.core.light.Relighting` does: in linear light, what is beyond white cut off. */
const RELIGHT = /* wgsl */ `
struct Lights { light: array<mat4x4f, 3>, captured: array<mat4x4f, 3> }
@group(0) @binding(2) var normals: texture_2d<f32>;
@group(0) @binding(3) var<uniform> lights: Lights;

fn irradiance(colors: array<mat4x4f, 3>, n: vec4f) -> vec3f {
  return max(vec3f(dot(n, colors[0] * n), dot(n, colors[1] * n), dot(n, colors[2] * n)), vec3f(0.0));
}

fn relit(color: vec3f, normal: vec3f) -> vec3f {
  let srgb = clamp(color, vec3f(0.0), vec3f(1.0));
  var linear = select(pow((srgb + 0.055) / 1.055, vec3f(2.4)), srgb / 12.92, srgb <= vec3f(0.04045));
  let size = length(normal);
  if (size > 1e-6) {
    let n = vec4f(normal / size, 1.0);
    linear *= irradiance(lights.light, n) / max(irradiance(lights.captured, n), vec3f(0.02));
  }
  linear = min(linear, vec3f(1.0));
  return select(1.055 * pow(linear, vec3f(1.0 / 2.4)) - 0.055, 12.92 * linear, linear <= vec3f(0.0031308));
}

fn shown(value: vec4f, normal: vec3f) -> vec3f {
  let share = 1.0 - value.a;
  if (share <= 1e-3) { return value.rgb; }
  return share * relit(value.rgb / share, normal);
}
`;
