/** What a bundle holds, tensor by tensor (`avatar/runtime/layout.py`), and the check of a file against it. */

import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import type { Piece, Tensor } from "./tensors.ts";

const NETWORK = {
  "of_point.weight": "f W X", "of_frame.weight": "f W Y", "of_frame.bias": "f W",
  "hidden.weight": "f H W W", "hidden.bias": "f H W", "last.weight": "f 3 W", "last.bias": "f 3",
};
const shapes = (side: string) =>
  prefixed(side, {
    rows: `i? ${side}m <N`, values: `q ${side}n 6 ${side}m`, step: `f? ${side}n 6`, exponent: `i? ${side}m`,
    "first.weight": `f ${side}w ${side}i`, "first.bias": `f ${side}w`,
    "hidden.weight": `f ${side}h ${side}w ${side}w`, "hidden.bias": `f ${side}h ${side}w`,
    "last.weight": `f ${side}o ${side}w`, "last.bias": `f ${side}o`,
  });

/**
 * Piece, tensor: kind, shape, bound. Kinds: f floats, or integers with a step and a start; i integers; q integers with
 * steps that stay so, or floats. Letters are sizes, the same in all pieces; `<J` bounds indices; ?: may be missing.
 */
export const PIECES: Record<string, Record<string, string>> = {
  skeleton: {
    parents: "i J", joints: "f J 3", expression: "f J 3 E", left_hand_mean: "f? 45", right_hand_mean: "f? 45",
    left_hand_components: "f? l 45", right_hand_components: "f? r 45",
  },
  surface: {
    vertices: "f V 3", faces: "i F 3 <V", parts: "i V", labels: "i V", colors: "i V 3", joint_indices: "i V k <J",
    joint_weights: "f V k", expression_rows: "i R <V", expression: "f R 3 E", pose_rows: "i? Q <V", pose: "f? Q 3 P",
  },
  gaussians: {
    per_face: "i F", barycentric: "f N 2", offset: "f N 3", log_scales: "f N 2", quats: "f N 4", opacities: "f N",
    dc: "f N 3", sh: "f N K 3", covered: "i? N", bare_offset: "f? N 3", bare_quats: "f? N 4", bare_scale: "f? N", bare_dc: "f? N 3",
  },
  field: {
    points: "f C 3", neighbours: "i V n <C", weights: "f V n", cloth: "i c <C", sets: "i S 21", member: "i C <S",
    codes: "f T Z", ...prefixed("body", NETWORK), ...prefixed("cloth", NETWORK),
  },
  regression: { level: "f C 3", basis: "f C 3 a", rows: "f a 63", center: "f 63", low: "f 63", high: "f 63" },
  blend: { ...shapes("head"), ...shapes("body"), part: "i? N" },
  poses: { known: "f D 63", scale: "f" },
};
/** How skin lies bare whose clothes are taken off; older bundles have none of it. */
export const BARE = ["bare_offset", "bare_quats", "bare_scale", "bare_dc"] as const;
const NEEDED = ["skeleton", "surface", "gaussians"];

function prefixed(side: string, specs: Record<string, string>): Record<string, string> {
  return Object.fromEntries(Object.entries(specs).map(([name, spec]) => [`${side}.${name}`, spec]));
}

const INTEGERS = /^[IU]\d/, LARGEST_INDEX = 2 ** 31;

/** The tensors of a bundle, of their kinds, shapes and bounds; by "piece.name". */
export class Tensors {
  /** Sizes by letter. */
  readonly sizes: Record<string, number> = {};
  private readonly all = new Map<string, Tensor>();

  constructor(pieces: Map<string, Piece>) {
    for (const [piece, specs] of Object.entries(PIECES)) {
      const tensors = pieces.get(piece)?.tensors;
      if (!tensors) {
        if (NEEDED.includes(piece)) throw new BundleError("the avatar", `a piece ${piece}`, "none", EXPORT_AGAIN);
        continue;
      }
      const left = new Set(tensors.keys());
      for (const [name, spec] of Object.entries(specs)) this.take(`${piece}.${name}`, name, spec, tensors, left);
      // A newer version may have given it a meaning.
      if (left.size) throw new BundleError(`piece ${piece}`, "the tensors of its version", [...left].join(", ").slice(0, 200), EXPORT_AGAIN);
    }
    this.checkBounds();
  }

  has(name: string): boolean {
    return this.all.has(name);
  }

  /** A tensor of floats. */
  floats(name: string): Float32Array {
    return this.all.get(name)!.values as Float32Array;
  }

  /** A tensor of integers. */
  ints(name: string): Int32Array {
    return this.all.get(name)!.values as Int32Array;
  }

  /** The values of blend shapes, as they are stored. */
  steps(name: string): Float32Array | Int8Array {
    return this.all.get(name)!.values as Float32Array | Int8Array;
  }

  private take(full: string, name: string, spec: string, tensors: Map<string, Tensor>, left: Set<string>): void {
    const [kind, ...letters] = spec.split(" "), floats = kind[0] === "f";
    const found = tensors.get(name);
    if (!found) {
      if (!kind.endsWith("?")) throw new BundleError(full, "a tensor", "none", EXPORT_AGAIN);
      return;
    }
    for (const used of floats ? [name, `${name}.step`, `${name}.start`] : [name]) left.delete(used);
    const dimensions = letters.filter((letter) => !letter.startsWith("<"));
    const fits = dimensions.length === found.shape.length && dimensions.every((letter, axis) => {
      const known = /^\d/.test(letter) ? Number(letter) : (this.sizes[letter] ??= found.shape[axis]);
      return known === found.shape[axis];
    });
    const floating = found.dtype.startsWith("F"), whole = INTEGERS.test(found.dtype);
    const numbers = kind[0] === "i" ? whole : floating || (whole && (kind[0] === "q" || tensors.has(`${name}.step`)));
    if (!fits || !numbers) {
      throw new BundleError(full, `${kind[0] === "i" ? "integers" : "numbers"} of shape (${dimensions.join(", ")})`,
        `${found.dtype} of shape (${found.shape.join(", ")})`, EXPORT_AGAIN);
    }
    let values = found.values;
    if (kind[0] === "i") {
      if (values.some((value) => value < -LARGEST_INDEX || value >= LARGEST_INDEX)) {
        throw new BundleError(full, "indices of 32 bits", "others", EXPORT_AGAIN);
      }
      values = values instanceof Int32Array ? values : Int32Array.from(values);
    } else if (!(kind[0] === "q" && values instanceof Int8Array)) values = decoded(full, found, floats ? tensors : new Map(), name);
    this.all.set(full, { ...found, values });
  }

  private checkBounds(): void {
    for (const [piece, specs] of Object.entries(PIECES)) {
      for (const [name, spec] of Object.entries(specs)) {
        const bound = spec.split("<")[1], full = `${piece}.${name}`;
        if (!bound || !this.has(full)) continue;
        const most = this.sizes[bound];
        if (this.ints(full).some((index) => index < 0 || index >= most)) {
          throw new BundleError(full, `indices below ${most}`, "others", EXPORT_AGAIN);
        }
      }
    }
  }
}

/** `start + step q`, steps for the last axes; plain floats as they are. */
function decoded(full: string, tensor: Tensor, tensors: Map<string, Tensor>, name: string): Float32Array {
  const out = Float32Array.from(tensor.values);
  for (const word of ["step", "start"] as const) {
    const other = tensors.get(`${name}.${word}`);
    if (!other) continue;
    const { dtype, shape, values } = other, last = tensor.shape.slice(tensor.shape.length - shape.length);
    if (!dtype.startsWith("F") || shape.length > tensor.shape.length || shape.some((n, axis) => n !== last[axis])) {
      throw new BundleError(`${full}.${word}`, `floats for the last axes of (${tensor.shape.join(", ")})`,
        `${dtype} of shape (${shape.join(", ")})`, EXPORT_AGAIN);
    }
    const by = values instanceof Float64Array ? Float32Array.from(values) : values;
    for (let i = 0, k = 0; i < out.length; ++i, k = k + 1 === by.length ? 0 : k + 1) {
      out[i] = word === "step" ? out[i] * by[k] : out[i] + by[k];
    }
  }
  if (!out.every(Number.isFinite)) throw new BundleError(full, "finite numbers", "NaN or infinity", EXPORT_AGAIN);
  return out;
}
