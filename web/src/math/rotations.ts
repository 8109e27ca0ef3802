/** Rotations: axis-angle vectors in radians, unit quaternions wxyz. */

export type Quaternion = [number, number, number, number];

/** The quaternion of an axis-angle vector. */
export function quaternionFromRotvec(vector: ArrayLike<number>, at = 0): Quaternion {
  const x = vector[at], y = vector[at + 1], z = vector[at + 2];
  const angle = Math.hypot(x, y, z);
  const s = angle > 1e-8 ? Math.sin(angle / 2) / angle : 0.5;
  return [Math.cos(angle / 2), s * x, s * y, s * z];
}

/** The axis-angle vector, of length pi at most, of a unit quaternion. */
export function rotvecFromQuaternion(q: Quaternion): [number, number, number] {
  const sign = q[0] < 0 ? -1 : 1;
  const length = Math.hypot(q[1], q[2], q[3]);
  const factor = length > 1e-12 ? (2 * Math.atan2(length, sign * q[0]) * sign) / length : 2 * sign;
  return [factor * q[1], factor * q[2], factor * q[3]];
}

/** The Hamilton product: first the turn by `b`, then that by `a`. */
export function multiply(a: Quaternion, b: Quaternion): Quaternion {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

/** On the sphere from `a` (share 0) to `b` (share 1), the short way round whatever the signs. */
export function slerp(a: Quaternion, b: Quaternion, share: number): Quaternion {
  let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = dot < 0 ? -1 : 1;
  dot = Math.min(1, Math.abs(dot));
  const angle = Math.acos(dot);
  const sine = Math.sin(angle);
  const of_a = sine > 1e-6 ? Math.sin((1 - share) * angle) / sine : 1 - share;
  const of_b = sign * (sine > 1e-6 ? Math.sin(share * angle) / sine : share);
  const q: Quaternion = [0, 0, 0, 0];
  for (let k = 0; k < 4; ++k) q[k] = of_a * a[k] + of_b * b[k];
  const length = Math.hypot(...q);
  return q.map((value) => value / length) as Quaternion;
}
