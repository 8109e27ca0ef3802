/** Light from all around as what a matt surface takes of it (`smplxpp.core.light`): nine harmonics, by colour. */

/** (9, 3) real harmonics up to degree 2 of a light's radiance, rows one after the other. */
export type Harmonics = readonly number[];

/** A light in another's place. */
export interface Light {
  name: string;
  light: Harmonics;
  /** In which the colours were photographed. */
  captured: Harmonics;
}

/** A picture in linear light, its first row straight above, +X in its middle column, columns going on to +Z. */
export interface Panorama {
  width: number;
  height: number;
  /** (H, W, 3) */
  pixels: Float32Array;
}

/** Factors of the polynomials in x, y and z that the harmonics are. */
const A = Math.sqrt(3 / (4 * Math.PI)), B = Math.sqrt(15 / (4 * Math.PI)), C = Math.sqrt(5 / (16 * Math.PI));
const CONSTANT = 0.5 / Math.sqrt(Math.PI);
/** What the cosine lobe over pi has of each harmonic (Ramamoorthi and Hanrahan 2001). */
const LOBE = [1, ...new Array(3).fill(2 / 3), ...new Array(5).fill(0.25)];
const LUMINANCE = [0.2126, 0.7152, 0.0722];
/** Numbers of `matrices`: three of 4 x 4 of the new light and of the captured one. */
export const MATRICES = 96;

function harmonics(x: number, y: number, z: number): number[] {
  return [CONSTANT, A * y, A * z, A * x, B * x * y, B * y * z, C * (3 * z * z - 1), B * x * z, 0.5 * B * (x * x - y * y)];
}

/** White light, the same from everywhere. */
export const WHITE: Harmonics = harmonics(0, 0, 0).flatMap((_, k) => new Array(3).fill(k ? 0 : Math.sqrt(4 * Math.PI)));

/**
 * The harmonics of a panorama, as bright in the mean as white light.
 *
 * @throws Error there is no light in it.
 */
export function harmonicsOf({ width, height, pixels }: Panorama): Harmonics {
  const total = new Array<number>(27).fill(0);
  for (let row = 0; row < height; ++row) {
    const polar = ((row + 0.5) * Math.PI) / height, up = Math.cos(polar), level = Math.sin(polar);
    const solid = (Math.cos((row * Math.PI) / height) - Math.cos(((row + 1) * Math.PI) / height)) * ((2 * Math.PI) / width);
    for (let column = 0; column < width; ++column) {
      const around = ((column + 0.5) / width - 0.5) * 2 * Math.PI, at = 3 * (row * width + column);
      const basis = harmonics(level * Math.cos(around), up, level * Math.sin(around));
      for (let k = 0; k < 27; ++k) total[k] += solid * basis[(k / 3) | 0] * pixels[at + (k % 3)];
    }
  }
  const mean = LUMINANCE.reduce((sum, share, k) => sum + share * total[k], 0) / Math.sqrt(4 * Math.PI);
  if (!(mean > 0) || !Number.isFinite(mean)) throw new Error("there is no light in this panorama");
  return total.map((value) => value / mean);
}

/**
 * The irradiance over pi of a normal n as `n M n` with n = (x, y, z, 1), a matrix a colour, of both lights.
 *
 * @param turn radians about +Y by which the new light is turned, as `--environment-turn` does.
 */
export function matrices({ light, captured }: Light, turn: number): Float32Array {
  const out = new Float32Array(MATRICES);
  [0, 1, 2].forEach((colour) => out.set(turned(matrix(light, colour), turn), 16 * colour));
  [0, 1, 2].forEach((colour) => out.set(matrix(captured, colour), 48 + 16 * colour));
  return out;
}

/** Symmetric, rows one after the other. */
function matrix(of: Harmonics, colour: number): number[] {
  const [c, y, z, x, xy, yz, zz, xz, xx] = LOBE.map((lobe, k) => lobe * of[3 * k + colour]);
  return [
    0.5 * B * xx, 0.5 * B * xy, 0.5 * B * xz, 0.5 * A * x,
    0.5 * B * xy, -0.5 * B * xx, 0.5 * B * yz, 0.5 * A * y,
    0.5 * B * xz, 0.5 * B * yz, 3 * C * zz, 0.5 * A * z,
    0.5 * A * x, 0.5 * A * y, 0.5 * A * z, CONSTANT * c - C * zz,
  ];
}

/** R M R^T: what was at an angle around the vertical is then by `turn` less. */
function turned(m: number[], turn: number): number[] {
  const cos = Math.cos(turn), sin = Math.sin(turn);
  const R = [cos, 0, sin, 0, 0, 1, 0, 0, -sin, 0, cos, 0, 0, 0, 0, 1];
  const product = (a: number[], b: (k: number, column: number) => number) =>
    R.map((_, at) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * (at >> 2) + k] * b(k, at & 3), 0));
  return product(product(R, (k, column) => m[4 * k + column]), (k, column) => R[4 * column + k]);
}
