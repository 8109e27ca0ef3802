/** What the server's messages hold: frames, and the sound that begins with the first of them. */

import type { Pose } from "../avatar/avatar.ts";
import { unpackTensors } from "../bundle/tensors.ts";

/** A sentence: its place in the conversation, its words, its samples. */
export interface Line {
  turn: number;
  line: number;
  text: string;
  rate: number;
  samples: Int16Array;
}

/** Frames `first` and on, which replace what was known of these and later ones; `now`: the server's present, seconds. */
export interface Frames {
  first: number;
  fps: number;
  now: number;
  count: number;
  width: number;
  rows: Float32Array;
  line: Line | null;
}

/** @throws BundleError what is no such message. */
export function readFrames(data: ArrayBuffer): Frames {
  const { tensors, about } = unpackTensors(new Uint8Array(data), "message of the server");
  const said = about as { first: number; fps: number; now: number; turn?: number; line?: number; text?: string; rate?: number };
  const rows = tensors.get("rows"), sound = tensors.get("sound");
  if (!rows || rows.shape.length !== 2 || !(rows.values instanceof Float32Array)) throw new Error("a message without frames");
  const line = sound && sound.values instanceof Int16Array
    ? { turn: said.turn ?? 0, line: said.line ?? 0, text: said.text ?? "", rate: said.rate ?? 22050, samples: sound.values }
    : null;
  return { first: said.first, fps: said.fps, now: said.now, count: rows.shape[0], width: rows.shape[1], rows: rows.values, line };
}

/** One row as a pose of so many joints: their axis-angle vectors, the translation, the expressions. */
export function poseOfRow(row: Float32Array, joints: number, expressions: number): Pose {
  const values = Float64Array.from(row), at = 3 * joints;
  const expression = new Float64Array(expressions);
  expression.set(values.subarray(at + 3, at + 3 + expressions));
  return { rotations: values.slice(0, at), translation: values.slice(at, at + 3), expression };
}
