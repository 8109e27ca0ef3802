/** Real spherical harmonics of degrees 1 to 3, in the order and with the signs of 3D Gaussian Splatting. */

const C1 = 0.4886025119029199;
const C2 = [1.0925484305920792, 0.31539156525252005, 0.5462742152960396];
const C3 = [0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277];

/** Writes the first `count` (3, 8 or 15) of them at a direction of length 1. */
export function harmonics(x: number, y: number, z: number, count: number, out: Float64Array): void {
  out[0] = -C1 * y;
  out[1] = C1 * z;
  out[2] = -C1 * x;
  if (count < 8) return;
  const xx = x * x, yy = y * y, zz = z * z;
  out[3] = C2[0] * x * y;
  out[4] = -C2[0] * y * z;
  out[5] = C2[1] * (2 * zz - xx - yy);
  out[6] = -C2[0] * x * z;
  out[7] = C2[2] * (xx - yy);
  if (count < 15) return;
  out[8] = -C3[0] * y * (3 * xx - yy);
  out[9] = C3[1] * x * y * z;
  out[10] = -C3[2] * y * (4 * zz - xx - yy);
  out[11] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy);
  out[12] = -C3[2] * x * (4 * zz - xx - yy);
  out[13] = C3[4] * z * (xx - yy);
  out[14] = -C3[0] * x * (xx - 3 * yy);
}
