/** The motion of a bundle: SMPL's parameters, a row a frame (`smplxpp/core/params.py`), to rotations of the joints. */

import type { Avatar, Motion } from "../avatar/avatar.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import type { Tensors } from "./layout.ts";
import type { Tensor } from "./tensors.ts";

const HAND = 45;
/** Arrays of parameters: numbers a frame (0: any), and whether a file may lack them, as zeros. */
const ARRAYS: Record<string, { width: number; optional?: boolean }> = {
  global_orient: { width: 3 }, body_pose: { width: 63 }, jaw_pose: { width: 3, optional: true }, leye_pose: { width: 3, optional: true },
  reye_pose: { width: 3, optional: true }, left_hand_pose: { width: HAND, optional: true }, right_hand_pose: { width: HAND, optional: true },
  betas: { width: 0 }, expression: { width: 0, optional: true }, transl: { width: 3 },
};
const SINGLES = ["fps", "flat_hand_mean"], OFFSETS = "v_shape";
/** Of radians and metres. */
const LARGEST = 1e6;
/** What a skeleton's joints take, in order. */
const BLOCKS: Record<number, string[]> = {
  55: ["global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose", "left_hand_pose", "right_hand_pose"],
  52: ["global_orient", "body_pose", "left_hand_pose", "right_hand_pose"],
  24: ["global_orient", "body_pose"],
};
const USUAL_RATE = 30;

interface Rows {
  values: Float32Array;
  frames: number;
  width: number;
}

/**
 * Reads it; hands in principal components become rotations.
 *
 * @param shaped the parameters may have a body's shape, which the avatar's stands for. @throws BundleError arrays that are
 *   unknown or do not fit the body.
 */
export function readMotion(piece: Map<string, Tensor>, avatar: Avatar, tensors: Tensors, subject = "motion", shaped = false): Motion {
  const wrong = (name: string, expected: string, received: string) => new BundleError(`${subject}: ${name}`, expected, received, EXPORT_AGAIN);
  const unknown = [...piece.keys()].find((name) => !Object.hasOwn(ARRAYS, name) && !SINGLES.includes(name) && !(shaped && name === OFFSETS));
  if (unknown !== undefined) throw wrong(unknown.slice(0, 80), "an array of body parameters", "another");
  // All arrays of as many frames; one row stands for all of them.
  const frames = piece.get("global_orient") ? rowsOf(piece.get("global_orient")!).frames : NaN;
  const all: Record<string, Rows> = {};
  for (const [name, { width, optional }] of Object.entries(ARRAYS)) {
    const tensor = piece.get(name);
    if (!tensor) {
      if (!optional) throw wrong(name, "a row of numbers a frame", "none");
      all[name] = { values: new Float32Array(frames * width), frames, width };
      continue;
    }
    const found = rowsOf(tensor), narrow = width === HAND && found.width < HAND;
    const fits = tensor.shape.length <= 2 && (!width || found.width === width || narrow) && (found.frames === frames || (found.frames === 1 && frames > 1));
    if (!fits) throw wrong(name, `${frames} rows of ${width || "any"} numbers`, `shape (${tensor.shape.join(", ")})`);
    if (!tensor.values.every((value) => Math.abs(value) <= LARGEST)) throw wrong(name, `finite numbers up to ${LARGEST}`, "others");
    const values = new Float32Array(frames * found.width);
    for (let f = 0; f < frames; ++f) values.set(found.frames === frames ? found.values.subarray(f * found.width, (f + 1) * found.width) : found.values, f * found.width);
    all[name] = { values, frames, width: found.width };
  }
  const joints = avatar.skeleton.parents.length, expressions = avatar.expressionNames.length;
  if (!frames) throw wrong("global_orient", "frames", "none");
  const { shape: offsets, values: places } = piece.get(OFFSETS) ?? { shape: [1, 3], values: [] as number[] };
  const whole = [2, 3].includes(offsets.length) && offsets.at(-1) === 3 && (offsets.length === 2 || [1, frames].includes(offsets[0]));
  if (!whole || ![...places].every((value) => Math.abs(value) <= LARGEST)) throw wrong(OFFSETS, "places of vertices", `shape (${offsets.join(", ")})`);
  if (all.betas.width && !shaped) throw wrong("betas", "none: the shape is the avatar's", `${all.betas.width} numbers a frame`);
  const { values: given, width } = all.expression;
  if (given.some((value, i) => value && i % width >= expressions)) throw wrong("expression", `zeros beyond the ${expressions} of the avatar`, `${width} numbers a frame`);
  const rate = single(piece, "fps", wrong), flat = single(piece, "flat_hand_mean", wrong) ?? 0;
  if (rate === 0) throw wrong("fps", "a number above 0", "0");
  if (flat > 1) throw wrong("flat_hand_mean", "0 or 1", String(flat));
  return {
    framesPerSecond: rate ?? USUAL_RATE, frames,
    rotations: turned(all, frames, joints, tensors, Boolean(flat), wrong),
    translation: all.transl.values,
    expression: padded(all.expression, expressions),
  };
}

/** Rotations of the joints, block by block. */
function turned(all: Record<string, Rows>, frames: number, joints: number, tensors: Tensors, flat: boolean, wrong: Wrong): Float32Array {
  const rotations = new Float32Array(frames * joints * 3);
  let start = 0;
  for (const name of BLOCKS[joints] ?? []) {
    const side = name.replace("_pose", ""), hand = side.endsWith("hand");
    const { values, width } = hand && all[name].width < HAND ? unfolded(all[name], tensors, side, wrong) : all[name];
    const mean = hand && !flat && tensors.has(`skeleton.${side}_mean`) ? tensors.floats(`skeleton.${side}_mean`) : null;
    for (let f = 0; f < frames; ++f) {
      for (let i = 0; i < width; ++i) rotations[f * 3 * joints + start + i] = values[f * width + i] + (mean ? mean[i] : 0);
    }
    start += width;
  }
  return rotations;
}

type Wrong = (name: string, expected: string, received: string) => BundleError;

/** An array as rows: a single row, or a single number, without its axes. */
function rowsOf({ shape, values }: Tensor): Rows {
  const width = shape.at(-1) ?? 1;
  return { values: Float32Array.from(values), frames: shape.length > 1 ? shape[0] : 1, width };
}

/** The one number of a tensor, 0 or above; null: it is not there. */
function single(piece: Map<string, Tensor>, name: string, wrong: Wrong): number | null {
  const tensor = piece.get(name);
  if (!tensor) return null;
  const [value] = tensor.values;
  if (tensor.values.length !== 1 || !Number.isFinite(value) || value < 0) throw wrong(name, "a number", `shape (${tensor.shape.join(", ")})`);
  return value;
}

/** Rows of so many numbers, the rest of each zero. */
function padded({ values, frames, width }: Rows, size: number): Float32Array {
  const out = new Float32Array(frames * size);
  for (let f = 0; f < frames; ++f) out.set(values.subarray(f * width, f * width + Math.min(width, size)), f * size);
  return out;
}

function unfolded({ values, frames, width }: Rows, tensors: Tensors, side: string, wrong: Wrong): Rows {
  const name = `skeleton.${side}_components`, known = tensors.has(name) ? tensors.floats(name).length / HAND : -1;
  if (width > known) throw wrong(`${side}_pose`, `${HAND} numbers a frame`, String(width));
  const basis = tensors.floats(name), out = new Float32Array(frames * HAND);
  for (let f = 0; f < frames; ++f) {
    for (let k = 0; k < width; ++k) {
      for (let i = 0; i < HAND; ++i) out[f * HAND + i] += values[f * width + k] * basis[k * HAND + i];
    }
  }
  return { values: out, frames, width: HAND };
}
