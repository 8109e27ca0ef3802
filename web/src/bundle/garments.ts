/** The loose clothes of a bundle (`smplxpp/cloth/garment_file.py`). */

import type { Avatar } from "../avatar/avatar.ts";
import { poseAt } from "../avatar/motion.ts";
import { edgesOf, type Fabric, type Garment } from "../cloth/garment.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import type { Tensors } from "./layout.ts";
import { readMotion } from "./motion.ts";
import type { Tensor } from "./tensors.ts";

const SCHEMA = 1;
/** Arrays of a garment: sizes by letter, and what integers are indices of (V: vertices of the avatar). */
const ARRAYS: Record<string, string> = {
  particles: "n <V", rest_vertices: "n 3", rest_faces: "m 3 <n", lengths: "e", depth: "n", vertices: "N <V", vertex_depth: "N",
  corners: "N 3 <n", weights: "N 3", offset: "N 3", collider_vertices: "c <V", collider_faces: "d 3 <c", collider_margin: "c",
  collider_deepest: "c",
};
const FABRIC: Record<keyof Fabric, number> = {
  density: 1e-9, stretch_stiffness: 1e-9, compression: 1e-9, bend_stiffness: 0, slack: 0, drag: 0, normal_drag: 0, inner_friction: 0,
  friction: 0,
};

/**
 * Reads them. @param about what the piece says of itself.
 *
 * @throws BundleError of a newer version, or arrays that do not fit.
 */
export function readGarments(piece: Map<string, Tensor>, about: unknown, avatar: Avatar, tensors: Tensors): Garment[] {
  const { schema, garments } = (about ?? {}) as { schema?: unknown; garments?: unknown };
  if (typeof schema !== "number" || !Array.isArray(garments)) throw wrong("garments", "a list and its version", "another thing");
  if (schema > SCHEMA) {
    throw new BundleError("garments of the avatar", `version ${SCHEMA} or older`, `version ${schema}`,
      "open it with the player of the smplxpp that wrote it");
  }
  return garments.map((row, k) => garment(piece, k, row ?? {}, avatar, tensors));
}

function garment(piece: Map<string, Tensor>, k: number, about: Record<string, unknown>, avatar: Avatar, tensors: Tensors): Garment {
  const own = checked(piece, k, avatar.mesh.vertices.length / 3), config = (about.config ?? {}) as Record<string, unknown>;
  const number = (from: Record<string, unknown>, name: string, least: number) => {
    const value = from[name];
    if (typeof value !== "number" || !(value >= least && value < 1e9)) throw wrong(`garment ${k}: ${name}`, "a number", String(value));
    return value;
  };
  const fabric = (config.fabric ?? {}) as Record<string, unknown>, prefix = `${k}.params.`;
  const params = new Map([...piece].filter(([name]) => name.startsWith(prefix)).map(([name, value]) => [name.slice(prefix.length), value]));
  const floats = (name: string) => Float32Array.from(own[name].values), doubles = (name: string) => Float64Array.from(own[name].values);
  const ints = (name: string) => Int32Array.from(own[name].values);
  const faces = ints("rest_faces"), lengths = doubles("lengths"), edges = edgesOf(faces, own.particles.shape[0]).length / 2;
  if (!faces.length || edges !== lengths.length) throw wrong(`garment ${k}: lengths`, `${edges} edges`, String(lengths.length));
  return {
    part: String(about.part),
    fabric: Object.fromEntries(Object.entries(FABRIC).map(([name, least]) => [name, number(fabric, name, least)])) as unknown as Fabric,
    pinDepth: number(config, "pin_depth", 0),
    band: number(config, "band", 1e-9),
    reference: poseAt(readMotion(params, avatar, tensors), 0),
    particles: ints("particles"), rest: doubles("rest_vertices"), faces, lengths,
    depth: doubles("depth"), vertexDepth: doubles("vertex_depth"), vertices: ints("vertices"),
    corners: ints("corners"), weights: floats("weights"), offset: floats("offset"),
    collider: {
      vertices: ints("collider_vertices"), faces: ints("collider_faces"), margin: floats("collider_margin"), deepest: floats("collider_deepest"),
    },
  };
}

/** The arrays, each of its shape, its numbers in bounds. */
function checked(piece: Map<string, Tensor>, k: number, vertices: number): Record<string, Tensor> {
  const sizes: Record<string, number> = { V: vertices, 3: 3 }, out: Record<string, Tensor> = {};
  for (const [name, spec] of Object.entries(ARRAYS)) {
    const letters = spec.split(" ").filter((letter) => !letter.startsWith("<")), found = piece.get(`${k}.${name}`);
    const fits = found?.shape.length === letters.length && letters.every((letter, axis) => (sizes[letter] ??= found.shape[axis]) === found.shape[axis]);
    // Depth is infinite where no way leads to what holds the cloth.
    const numbers = fits && (name.endsWith("depth") ? found.values.every((value) => value >= 0) : found.values.every(Number.isFinite));
    if (!numbers) throw wrong(`garment ${k}: ${name}`, `numbers of shape (${letters.join(", ")})`, `shape (${found?.shape.join(", ") ?? "none"})`);
    out[name] = found;
  }
  for (const [name, spec] of Object.entries(ARRAYS)) {
    const bound = spec.split("<")[1];
    if (bound && out[name].values.some((index) => !Number.isInteger(index) || index < 0 || index >= sizes[bound])) {
      throw wrong(`garment ${k}: ${name}`, `indices below ${sizes[bound]}`, "others");
    }
  }
  return out;
}

function wrong(subject: string, expected: string, received: string): BundleError {
  return new BundleError(subject, expected, received, EXPORT_AGAIN);
}
