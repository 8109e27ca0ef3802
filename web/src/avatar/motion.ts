/** Poses between the frames of a motion, and turned by hand. */

import type { Motion, Pose } from "./avatar.ts";
import { multiply, quaternionFromRotvec, rotvecFromQuaternion, slerp } from "../math/rotations.ts";

/** The T-pose. */
export function restPose(joints: number, expressions: number): Pose {
  return {
    rotations: new Float64Array(3 * joints),
    translation: new Float64Array(3),
    expression: new Float64Array(expressions),
  };
}

/** Seconds that a motion lasts: from its first frame to its last. */
export function duration(motion: Motion): number {
  return (motion.frames - 1) / motion.framesPerSecond;
}

/** The pose at a time, seconds from the first frame: joints on the sphere, the rest along lines. */
export function poseAt(motion: Motion, time: number): Pose {
  const at = Math.min(Math.max(time * motion.framesPerSecond, 0), motion.frames - 1);
  const first = Math.min(Math.floor(at), Math.max(motion.frames - 2, 0)), share = at - first;
  const second = Math.min(first + 1, motion.frames - 1);
  const mixed = (values: Float32Array) => {
    const width = values.length / motion.frames, out = new Float64Array(width);
    for (let i = 0; i < width; ++i) out[i] = (1 - share) * values[first * width + i] + share * values[second * width + i];
    return out;
  };
  const width = motion.rotations.length / motion.frames, rotations = new Float64Array(width);
  for (let i = 0; i < width; i += 3) {
    const [from, to] = [first, second].map((frame) => frame * width + i);
    // A frame itself is given as it is: its vector may be longer than pi.
    if (share === 0) rotations.set(motion.rotations.subarray(from, from + 3), i);
    else {
      const [a, b] = [from, to].map((k) => quaternionFromRotvec(motion.rotations, k));
      rotations.set(rotvecFromQuaternion(slerp(a, b, share)), i);
    }
  }
  return { rotations, translation: mixed(motion.translation), expression: mixed(motion.expression) };
}

/** The pose on the way from one to another, joints on the sphere, the rest along lines; `share` in [0, 1]. */
export function between(start: Pose, end: Pose, share: number): Pose {
  const mixed = (a: Float64Array, b: Float64Array) => a.map((value, i) => (1 - share) * value + share * b[i]);
  const rotations = new Float64Array(end.rotations.length);
  for (let i = 0; i < rotations.length; i += 3) {
    const [a, b] = [start, end].map((pose) => quaternionFromRotvec(pose.rotations, i));
    rotations.set(rotvecFromQuaternion(slerp(a, b, share)), i);
  }
  return { rotations, translation: mixed(start.translation, end.translation), expression: mixed(start.expression, end.expression) };
}

/** A pose with joints turned further: axis-angle vectors, radians, in the joints' own frames. */
export function turned(pose: Pose, turns: ReadonlyMap<number, readonly [number, number, number]>): Pose {
  const rotations = pose.rotations.slice();
  for (const [joint, turn] of turns) {
    const whole = multiply(quaternionFromRotvec(rotations, 3 * joint), quaternionFromRotvec(turn));
    rotations.set(rotvecFromQuaternion(whole), 3 * joint);
  }
  return { ...pose, rotations };
}
