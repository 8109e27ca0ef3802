/** Projection and blending as `docs/rendering.md` says, in GLSL. */

/** A shader of pictures in another light: with `LIT` normals are blended beside colours. */
export function lit(shader: string): string {
  return shader.replace("\n", "\n#define LIT\n");
}

/** The ellipse of a Gaussian where alpha reaches 1/255, along its own axes, and one of its corners. */
export const PROJECTION = `
uniform mat3 rotation;
uniform vec3 translation;
uniform vec4 pinhole;
uniform vec2 size;
uniform float blur;

struct Ellipse {
  bool visible;
  vec3 middle;
  float reach;
  vec2 pixel;
};

Ellipse ellipse(vec4 place, vec4 covariance0, vec2 covariance1, vec2 corner) {
  vec3 p = rotation * place.xyz + translation;
  float reach = log(255.0 * place.w);
  if (!(p.z >= 0.01) || !(reach > 0.0)) return Ellipse(false, p, reach, vec2(0.0));
  vec2 focal = pinhole.xy, middle = pinhole.zw;
  vec2 center = focal * p.xy / p.z + middle;

  // The derivative is taken inside the picture, widened by 15 % on every side.
  vec2 low = (-0.15 * size - middle) / focal, high = (1.15 * size - middle) / focal;
  vec2 slope = clamp(p.xy / p.z, low, high);
  vec3 jx = vec3(focal.x / p.z, 0.0, -focal.x * slope.x / p.z) * rotation;
  vec3 jy = vec3(0.0, focal.y / p.z, -focal.y * slope.y / p.z) * rotation;
  mat3 v = mat3(covariance0.x, covariance0.y, covariance0.z, covariance0.y, covariance0.w, covariance1.x,
    covariance0.z, covariance1.x, covariance1.y);
  vec3 vx = v * jx, vy = v * jy;
  float a = dot(jx, vx) + blur, b = dot(jx, vy), c = dot(jy, vy) + blur;

  float mean = 0.5 * (a + c), spread = sqrt(0.25 * (a - c) * (a - c) + b * b);
  float angle = 0.5 * atan(2.0 * b, a - c);
  vec2 along = vec2(cos(angle), sin(angle));
  // Half axes where sigma = reach: sqrt(2 reach lambda).
  float longer = sqrt(2.0 * reach * (mean + spread)), shorter = sqrt(2.0 * reach * max(mean - spread, 1e-9));
  vec2 pixel = center + corner.x * longer * along + corner.y * shorter * vec2(-along.y, along.x);
  return Ellipse(true, p, reach, pixel);
}
`;

/** One Gaussian an instance, four corners. */
export const SPLAT_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec4 place;
layout(location = 1) in vec4 covariance0;
layout(location = 2) in vec2 covariance1;
layout(location = 3) in vec4 color;
out vec2 at;
flat out vec4 paint;
flat out float reach;
${PROJECTION}
#ifdef LIT
flat out vec3 facing;

// What web/splats.cpp has folded.
vec3 unfolded(float code) {
  if (code == 0.0) return vec3(0.0);
  float high = floor(code / 4096.0);
  vec2 at = (vec2(high, code - 4096.0 * high) - 2048.0) / 2047.0;
  float z = 1.0 - abs(at.x) - abs(at.y), over = max(-z, 0.0);
  return normalize(vec3(at.x - (at.x < 0.0 ? -over : over), at.y - (at.y < 0.0 ? -over : over), z));
}
#endif

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  at = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  Ellipse seen = ellipse(place, covariance0, covariance1, at);
  reach = seen.reach;
  if (!seen.visible) return;
  paint = vec4(color.rgb, place.w);
#ifdef LIT
  facing = unfolded(color.w);
#endif
  gl_Position = vec4(2.0 * seen.pixel.x / size.x - 1.0, 1.0 - 2.0 * seen.pixel.y / size.y, 0.0, 1.0);
}`;

/** Front to back: the target holds colour so far, and in alpha what still shines through. */
export const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
flat in vec4 paint;
flat in float reach;
layout(location = 0) out vec4 result;
#ifdef LIT
flat in vec3 facing;
layout(location = 1) out vec4 normal;
#endif

void main() {
  float square = dot(at, at);
  if (square > 1.0) discard;
  float alpha = min(0.999, paint.a * exp(-reach * square));
  result = vec4(paint.rgb * alpha, alpha);
#ifdef LIT
  normal = vec4(facing * alpha, alpha);
#endif
}`;

/** Two triangles over everything. */
export const WHOLE_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 4.0 * float(gl_VertexID >> 1) - 1.0, 0.0, 1.0);
}`;

export const RESOLVE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D blended;
uniform vec4 background;
uniform ivec2 corner;
out vec4 result;
#ifdef LIT
uniform sampler2D normals;
uniform mat4 light[3];
uniform mat4 captured[3];

vec3 irradiance(mat4 colors[3], vec4 n) {
  return max(vec3(dot(n, colors[0] * n), dot(n, colors[1] * n), dot(n, colors[2] * n)), 0.0);
}

// As smplxpp.core.light.Relighting does: in linear light, what is beyond white cut off.
vec3 relit(vec3 color, vec3 normal) {
  vec3 srgb = clamp(color, 0.0, 1.0);
  vec3 linear = mix(srgb / 12.92, pow((srgb + 0.055) / 1.055, vec3(2.4)), step(0.04045, srgb));
  float size = length(normal);
  if (size > 1e-6) {
    vec4 n = vec4(normal / size, 1.0);
    linear *= irradiance(light, n) / max(irradiance(captured, n), 0.02);
  }
  linear = min(linear, 1.0);
  return mix(12.92 * linear, 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, linear));
}
#endif

void main() {
  vec4 value = texelFetch(blended, ivec2(gl_FragCoord.xy) - corner, 0);
#ifdef LIT
  float share = 1.0 - value.a;
  if (share > 1e-3) value.rgb = share * relit(value.rgb / share, texelFetch(normals, ivec2(gl_FragCoord.xy) - corner, 0).xyz);
#endif
  // Premultiplied, as browsers want what is seen through.
  result = vec4(value.rgb + value.a * background.a * background.rgb, 1.0 - value.a * (1.0 - background.a));
}`;
