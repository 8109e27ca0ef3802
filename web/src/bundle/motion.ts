/** The motion of a bundle: SMPL's parameters, a row a frame, to rotations of the joints. */

import type { Avatar, Motion } from "../avatar/avatar.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import type { Tensors } from "./layout.ts";
import type { Tensor } from "./tensors.ts";

const HAND = 45;
/** What a skeleton's joints take, in order. */
const BLOCKS: Record<number, string[]> = {
  55: ["global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose", "left_hand_pose", "right_hand_pose"],
  52: ["global_orient", "body_pose", "left_hand_pose", "right_hand_pose"],
  24: ["global_orient", "body_pose"],
};
const USUAL_RATE = 30;

/** Reads it; hands in principal components become rotations. */
export function readMotion(piece: Map<string, Tensor>, avatar: Avatar, tensors: Tensors): Motion {
  const joints = avatar.skeleton.parents.length, expressions = avatar.expressionNames.length;
  const rows = (name: string): Tensor => {
    const tensor = piece.get(name);
    if (tensor?.shape.length !== 2 || !tensor.values.every(Number.isFinite)) {
      throw new BundleError(`motion: ${name}`, "a row of numbers a frame", "none", EXPORT_AGAIN);
    }
    return tensor;
  };
  const frames = rows("global_orient").shape[0];
  const flat = Boolean(piece.get("flat_hand_mean")?.values[0]);
  const rotations = new Float32Array(frames * joints * 3);
  let start = 0;
  for (const name of BLOCKS[joints] ?? []) {
    const tensor = rows(name), side = name.replace("_pose", "");
    const hand = side.endsWith("hand"), width = hand ? HAND : tensor.shape[1];
    const mean = hand && !flat && tensors.has(`skeleton.${side}_mean`) ? tensors.floats(`skeleton.${side}_mean`) : null;
    const values = hand && tensor.shape[1] < HAND ? unfolded(tensor, tensors, side) : tensor.values;
    if (values.length !== frames * width || start + width > 3 * joints) {
      throw new BundleError(`motion: ${name}`, `${frames} frames`, `shape (${tensor.shape.join(", ")})`, EXPORT_AGAIN);
    }
    for (let f = 0; f < frames; ++f) {
      for (let i = 0; i < width; ++i) {
        rotations[f * 3 * joints + start + i] = values[f * width + i] + (mean ? mean[i] : 0);
      }
    }
    start += width;
  }
  const given = rows("expression"), width = given.shape[1], expression = new Float32Array(frames * expressions);
  for (let f = 0; f < Math.min(frames, given.shape[0]); ++f) {
    for (let e = 0; e < Math.min(expressions, width); ++e) expression[f * expressions + e] = given.values[f * width + e];
  }
  const translation = Float32Array.from(rows("transl").values);
  if (!frames || translation.length !== 3 * frames) {
    throw new BundleError("motion: transl", `${frames} frames`, `${translation.length / 3}`, EXPORT_AGAIN);
  }
  return {
    framesPerSecond: Number(piece.get("fps")?.values[0] ?? USUAL_RATE) || USUAL_RATE,
    frames, rotations, translation, expression,
  };
}

function unfolded(tensor: Tensor, tensors: Tensors, side: string): Float32Array {
  const [frames, width] = tensor.shape, name = `skeleton.${side}_components`;
  if (!tensors.has(name) || tensors.floats(name).length < width * HAND) {
    throw new BundleError(`motion: ${side}_pose`, `${HAND} numbers a frame`, `${width}`, EXPORT_AGAIN);
  }
  const basis = tensors.floats(name), out = new Float32Array(frames * HAND);
  for (let f = 0; f < frames; ++f) {
    for (let k = 0; k < width; ++k) {
      for (let i = 0; i < HAND; ++i) out[f * HAND + i] += tensor.values[f * width + k] * basis[k * HAND + i];
    }
  }
  return out;
}
