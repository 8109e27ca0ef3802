/** The loose clothes of a bundle (`smplxpp/cloth/garment_file.py`). */

import type { Avatar } from "../avatar/avatar.ts";
import { poseAt } from "../avatar/motion.ts";
import { edgesOf, type Fabric, type Garment } from "../cloth/garment.ts";
import { UNTOLD, type Simulation } from "../cloth/simulation.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import { asInteger, asList, asNumber, asObject, asText } from "./json.ts";
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
/** Their kinds: indices of vertices are integers of any kind, doubles were narrowed or not. */
const WHOLE = ["I64", "I32", "I16", "I8", "U64", "U32", "U16", "U8"], WIDE = ["F32", "F64"];
const DTYPES: Record<string, string[]> = {
  particles: WHOLE, rest_vertices: WIDE, rest_faces: ["I64"], lengths: WIDE, depth: WIDE, vertices: WHOLE, vertex_depth: WIDE,
  corners: ["I32"], weights: ["F32"], offset: ["F32"], collider_vertices: WHOLE, collider_faces: ["I32"], collider_margin: ["F32"],
  collider_deepest: ["F32"],
};
/** Numbers of a fabric and of a garment, and whether 0 is one of them. */
const FABRIC: Record<keyof Fabric, boolean> = {
  density: false, stretch_stiffness: false, compression: false, bend_stiffness: true, slack: true, drag: true, normal_drag: true,
  inner_friction: true, friction: true,
};
const CONFIG = { spacing: false, collider_spacing: false, pin_depth: false, band: false, skin_margin: true, sheet_margin: true };
const MOST = 1e9;
/** Numbers of a simulation that are whole, that are steps of time, and that may be 0. */
const COUNTS = ["contacts_every"], STEPS = ["substep", "ramp_step"];
const MAY_BE_0 = ["ramp", "hold", "beside", "drawn_margin", "own_margin", "gravity"];

/**
 * Reads them. @param about what the piece says of itself.
 *
 * @throws BundleError of a newer version, or arrays that do not fit.
 */
export function readGarments(piece: Map<string, Tensor>, about: Record<string, unknown>, avatar: Avatar, tensors: Tensors): Garment[] {
  const schema = asNumber(about.schema, "garments: schema", 1, Infinity), rows = asList(about.garments, "garments");
  if (schema > SCHEMA) {
    throw new BundleError("garments of the avatar", `version ${SCHEMA} or older`, `version ${schema}`,
      "open it with the player of the smplxpp that wrote it");
  }
  const own = /^(\d+)\.(?:params\.)?(\w+)$/;
  for (const name of piece.keys()) {
    const [, k, array] = own.exec(name) ?? [];
    const known = name.includes(".params.") || Object.hasOwn(ARRAYS, array ?? "");
    if (!known || String(Number(k)) !== k || Number(k) >= rows.length) throw wrong("garments", "the arrays of their version", name.slice(0, 80));
  }
  return rows.map((row, k) => garment(piece, k, asObject(row, `garment ${k}`), avatar, tensors));
}

/** Reads how garments are stepped; numbers that the piece lacks are those of bundles that say nothing of it. */
export function readSimulation(about: Record<string, unknown>): Simulation {
  const { solver, floor, ...usual } = UNTOLD, told = (value: unknown, subject: string) => (value === undefined ? {} : asObject(value, subject));
  const stored = told(about.simulation, "simulation");
  return {
    ...options(stored, usual),
    floor: stored.floor === undefined || stored.floor === null ? floor : asNumber(stored.floor, "simulation: floor", -1e4, 1e4),
    solver: options(told(stored.solver, "simulation: solver"), solver),
  };
}

/** Numbers by name, up to ten times the usual ones, steps of time from a tenth of these: others would halt the page. */
function options<Numbers extends { [name in keyof Numbers]: number }>(stored: Record<string, unknown>, usual: Numbers): Numbers {
  return Object.fromEntries(Object.entries<number>(usual).map(([name, value]) => {
    if (!Object.hasOwn(stored, name)) return [name, value];
    const subject = `simulation: ${name}`;
    if (COUNTS.includes(name)) return [name, asInteger(stored[name], subject, 1, Math.max(10 * value, 0.1))];
    const found = asNumber(stored[name], subject, STEPS.includes(name) ? 0.1 * value : 0, Math.max(10 * value, 0.1));
    const least = name.startsWith("most_stretch") || name === "most_drawn" ? 1 : 0;
    if (found < least || (!found && !MAY_BE_0.includes(name))) throw wrong(subject, least ? "1 or more" : "a number above 0", String(found));
    return [name, found];
  })) as Numbers;
}

function garment(piece: Map<string, Tensor>, k: number, about: Record<string, unknown>, avatar: Avatar, tensors: Tensors): Garment {
  const own = checked(piece, k, avatar.mesh.vertices.length / 3), config = asObject(about.config, `garment ${k}: config`);
  const numbers = <Name extends string>(from: Record<string, unknown>, names: Record<Name, boolean>) =>
    Object.fromEntries(Object.entries<boolean>(names).map(([name, zero]) => {
      const value = asNumber(from[name], `garment ${k}: ${name}`, 0, MOST);
      if (!zero && !value) throw wrong(`garment ${k}: ${name}`, "a number above 0", "0");
      return [name, value];
    })) as Record<Name, number>;
  const options = numbers(config, CONFIG), prefix = `${k}.params.`;
  const params = new Map([...piece].filter(([name]) => name.startsWith(prefix)).map(([name, value]) => [name.slice(prefix.length), value]));
  const reference = readMotion(params, avatar, tensors, `garment ${k}: reference pose`, true);
  if (reference.frames !== 1) throw wrong(`garment ${k}`, "one reference pose", `${reference.frames}`);
  const floats = (name: string) => Float32Array.from(own[name].values), doubles = (name: string) => Float64Array.from(own[name].values);
  const ints = (name: string) => Int32Array.from(own[name].values);
  const faces = ints("rest_faces"), lengths = doubles("lengths"), edges = edgesOf(faces, own.particles.shape[0]).length / 2;
  if (!faces.length || edges !== lengths.length) throw wrong(`garment ${k}: lengths`, `${edges} edges`, String(lengths.length));
  return {
    part: asText(about.part, `garment ${k}: part`),
    fabric: numbers(asObject(config.fabric, `garment ${k}: fabric`), FABRIC),
    spacing: options.spacing,
    pinDepth: options.pin_depth,
    band: options.band,
    reference: poseAt(reference, 0),
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
    const kind = fits && DTYPES[name].includes(found.dtype);
    // Depth is infinite where no way leads to what holds the cloth.
    const numbers = kind && (name.endsWith("depth") ? found.values.every((value) => value >= 0) : found.values.every(Number.isFinite));
    if (!numbers) throw wrong(`garment ${k}: ${name}`, `numbers of shape (${letters.join(", ")})`, `${found?.dtype} of shape (${found?.shape.join(", ") ?? "none"})`);
    out[name] = found;
  }
  for (const [name, spec] of Object.entries(ARRAYS)) {
    const bound = spec.split("<")[1];
    if (bound && out[name].values.some((index) => !Number.isInteger(index) || index < 0 || index >= sizes[bound])) {
      throw wrong(`garment ${k}: ${name}`, `indices below ${sizes[bound]}`, "others");
    }
  }
  if (!sizes.n || !sizes.N || !sizes.m) throw wrong(`garment ${k}`, "particles, faces and vertices", "none");
  return out;
}

function wrong(subject: string, expected: string, received: string): BundleError {
  return new BundleError(subject, expected, received, EXPORT_AGAIN);
}
