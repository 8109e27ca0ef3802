/** What an avatar says of itself, and whether its tensors agree with it and each other (`avatar/runtime/layout.py`). */

import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import { asBoolean, asInteger, asList, asNumber, asObject, asText } from "./json.ts";
import { BARE, type Tensors } from "./layout.ts";

/** Numbers of joints of SMPL-X, SMPL+H and SMPL. */
const JOINTS = [55, 52, 24];
const MOST_GAUSSIANS = 2 ** 22, BUILT_IN_LABELS = 7, MOST_COLORS = 256, MOST_EXPONENT = 24, MOST_BANDS = 96;
/** Harmonics of degree 1 to d have (d + 1)^2 - 1 coefficients. */
const HARMONICS = [0, 3, 8, 15];
const POSE_INPUTS = 63, JAW_INPUTS = 3, MOST_BLUR = 100;
/** Weights of 16 bits miss a sum of 1 by rounding; a rotation without a length has no direction. */
const SUM_TOLERANCE = 0.01, LEAST_LENGTH = 1e-3, MOST_LENGTH = 1e3;
/** Of radians and metres. */
const LARGEST = 1e6;

/** The description of an avatar in its manifest. */
export interface About {
  name: string;
  licence: string;
  provenance: Record<string, string>;
  jointNames: string[];
  expressionNames: string[];
  partNames: string[];
  frames: number;
  nullCodeShown: boolean;
  jaw: boolean;
  blur: number;
}

/** Reads it; unknown fields are ignored. @throws BundleError a field that is missing or of another kind. */
export function readAbout(value: unknown): About {
  const model = asObject(value, "model"), texts = (name: string) => asList(model[name], name).map((one) => asText(one, name));
  const notes = (name: string) => {
    const found = asObject(model[name], name);
    for (const one of Object.values(found)) asText(one, name);
    return found as Record<string, string>;
  };
  notes("reductions");
  return {
    name: asText(model.name, "name"),
    licence: asText(model.licence, "licence"),
    provenance: notes("provenance"),
    jointNames: texts("joint_names"),
    expressionNames: texts("expression_names"),
    partNames: texts("part_names"),
    frames: asList(model.frames, "frames").map((one) => asInteger(one, "frames", 0)).length,
    nullCodeShown: asBoolean(model.null_code_shown, "null_code_shown"),
    jaw: asBoolean(model.jaw, "jaw"),
    blur: asNumber(model.eps2d, "eps2d", 0, MOST_BLUR),
  };
}

/** Checks the values of tensors where their shapes do not suffice. @throws BundleError of the first that is wrong. */
export function checkConsistency(about: About, t: Tensors): void {
  const { J, E, N, K, P, X, Y, Z, T } = t.sizes, near = (value: number) => Math.abs(value) <= LARGEST;
  for (const name of ["skeleton.joints", "surface.vertices"]) require(t.floats(name).every(near), name, `metres up to ${LARGEST}`);
  // The skeleton: every parent before its children.
  require(JOINTS.includes(J), "joints", JOINTS.join(" or "), J);
  require(t.ints("skeleton.parents").every((parent, j) => (j ? parent >= 0 && parent < j : parent === -1)), "skeleton.parents", "every parent before its children");
  for (const [what, names, count] of [["joint_names", about.jointNames, J], ["expression_names", about.expressionNames, E]] as const) {
    require(names.length === count, what, `${count} names`, names.length);
  }
  // The Gaussians.
  require(N > 0 && N <= MOST_GAUSSIANS, "gaussians", `1 to ${MOST_GAUSSIANS}`, N);
  const perFace = t.ints("gaussians.per_face");
  require(perFace.every((count) => count >= 0) && sum(perFace) === N, "gaussians.per_face", `counts of ${N}`);
  require(HARMONICS.includes(K), "gaussians.sh", `${HARMONICS.join(", ")} coefficients`, K);
  const usable = (row: Float32Array) => Math.hypot(...row) > LEAST_LENGTH && Math.hypot(...row) < MOST_LENGTH;
  for (const name of ["gaussians.quats", "gaussians.bare_quats"].filter((name) => t.has(name))) {
    require(everyRow(t.floats(name), 4, usable), name, `lengths from ${LEAST_LENGTH} to ${MOST_LENGTH}`);
  }
  require(t.floats("gaussians.opacities").every((value) => value >= 0 && value <= 1), "gaussians.opacities", "values in [0, 1]");
  const covered = t.has("gaussians.covered") ? t.ints("gaussians.covered") : Int32Array.of();
  const most = Math.max(1, about.partNames.length);
  require(covered.every((part) => part >= 0 && part < most), "gaussians.covered", `parts in [0, ${about.partNames.length})`);
  const bare = BARE.filter((name) => t.has(`gaussians.${name}`)).length;
  require(!bare || (bare === BARE.length && t.has("gaussians.covered")), "gaussians.bare_*", "all or none");
  if (bare) require(t.floats("gaussians.bare_scale").every((value) => value > 0), "gaussians.bare_scale", "positive numbers");
  // The surface: the skin first, because expressions and correctives index it alone.
  const weights = t.floats("surface.joint_weights"), parts = t.ints("surface.parts");
  const summed = (row: Float32Array) => Math.abs(sum(row) - 1) < SUM_TOLERANCE;
  require(weights.every((value) => value >= 0) && (t.sizes.k ? everyRow(weights, t.sizes.k, summed) : !t.sizes.V), "surface.joint_weights", "rows that sum to 1");
  for (const [name, most] of [["parts", about.partNames.length], ["labels", BUILT_IN_LABELS], ["colors", MOST_COLORS]] as const) {
    require(t.ints(`surface.${name}`).every((value) => value >= 0 && value < most), `surface.${name}`, `values in [0, ${most})`);
  }
  require(parts.every((part, i) => !i || part >= parts[i - 1]), "surface.parts", "the parts one after the other");
  const skin = parts.filter((part) => !part).length;
  for (const name of ["surface.expression_rows", "surface.pose_rows"]) {
    if (!t.has(name)) continue;
    const rows = t.ints(name);
    require(increasing(rows) && (rows.at(-1) ?? -1) < skin, name, `increasing indices below ${skin}`);
  }
  require(t.has("surface.pose") === t.has("surface.pose_rows"), "surface.pose", "correctives with their vertices, or neither");
  if (t.has("surface.pose")) require(P === 9 * (J - 1), "surface.pose", `${9 * (J - 1)} directions`, P);
  // The field: a positional encoding has 3 + 6 L numbers.
  if (t.has("field.points")) {
    require((X - 3) % 6 === 0 && X >= 3 && X - 3 <= MOST_BANDS, "field", "bands of sines and cosines", `${X - 3} inputs`);
    require(Y === POSE_INPUTS + Z, "field of_frame", `${POSE_INPUTS + Z} inputs`, Y);
    require(T === about.frames && T > 0, "field.codes", `${about.frames} codes`, T);
  }
  if (t.has("regression.level")) {
    require(t.has("field.points"), "regression", "a field whose points it moves", "none");
    const high = t.floats("regression.high");
    require(t.floats("regression.low").every((value, i) => value <= high[i]), "regression.low", "at most `high`");
  }
  if (t.has("poses.known")) {
    const known = t.floats("poses.known");
    require(t.floats("poses.scale")[0] > 0 && known.length > 0 && known.every(near), "poses", `poses of at most ${LARGEST}, a scale above 0`);
  }
  if (t.has("blend.head.values")) checkBlend(about, t);
}

function checkBlend(about: About, t: Tensors): void {
  // The head is driven by the expression, or by it and the jaw's three angles; the body by angles of the pose.
  const { sizes } = t, part = t.has("blend.part") ? t.ints("blend.part") : Int32Array.of(0);
  require(part.every((one) => one >= 0), "blend.part", "no negative number");
  const parts = 1 + part.reduce((most, one) => Math.max(most, one), 0);
  const inputs = { head: sizes.E + (about.jaw ? JAW_INPUTS : 0), body: POSE_INPUTS };
  for (const side of ["head", "body"] as const) {
    const [shapes, rows, outputs] = [sizes[`${side}n`], sizes[`${side}m`], sizes[`${side}o`]], own = `blend.${side}`;
    require(outputs % Math.max(shapes, 1) === 0 && outputs >= parts * shapes, own, `${parts} x ${shapes} coefficients`, outputs);
    require(sizes[`${side}i`] === inputs[side], own, `${inputs[side]} inputs`, sizes[`${side}i`]);
    if (t.has(`${own}.rows`)) require(increasing(t.ints(`${own}.rows`)), `${own}.rows`, "increasing numbers");
    else require(rows === sizes.N, own, `${sizes.N} rows`, rows);
    require(t.steps(`${own}.values`) instanceof Int8Array === t.has(`${own}.step`), `${own}.step`, "steps of integers");
    const exponent = t.has(`${own}.exponent`) ? t.ints(`${own}.exponent`) : Int32Array.of();
    require(exponent.every((one) => one >= 0 && one <= MOST_EXPONENT), `${own}.exponent`, `0 to ${MOST_EXPONENT}`);
  }
}

function require(condition: boolean, what: string, expected: string, received: number | string = "others"): void {
  if (!condition) throw new BundleError(what, expected, String(received), EXPORT_AGAIN);
}

function sum(values: Int32Array | Float32Array): number {
  return (values as Float32Array).reduce((total, value) => total + value, 0);
}

function increasing(rows: Int32Array): boolean {
  return rows.every((row, i) => !i || row > rows[i - 1]);
}

function everyRow(values: Float32Array, width: number, good: (row: Float32Array) => boolean): boolean {
  for (let at = 0; at < values.length; at += width) if (!good(values.subarray(at, at + width))) return false;
  return true;
}
