/** A bundle, `NAME.avatar`, to an avatar that can be posed. */

import type { Avatar, BlendShapes, BlendSide, Field, FieldNetwork, Gaussians, Layer } from "../avatar/avatar.ts";
import { encodedPoints } from "../avatar/networks.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import { readGarments } from "./garments.ts";
import { Tensors } from "./layout.ts";
import { readMotion } from "./motion.ts";
import { sha256 } from "./sha256.ts";
import { unpackTensors, type Piece } from "./tensors.ts";
import { unzip } from "./zip.ts";

const FORMAT = "smplxpp-avatar", VERSION = 2;
/** Scale of every Gaussian along its normal, in mean edge lengths of its triangle. */
const THICKNESS = 0.01;

interface Manifest {
  format?: string;
  version?: number;
  model?: {
    name?: string;
    licence?: string;
    provenance?: Record<string, string>;
    joint_names?: string[];
    expression_names?: string[];
    part_names?: string[];
    null_code_shown?: boolean;
    jaw?: boolean;
    eps2d?: number;
  };
  pieces?: Record<string, { file?: string; bytes?: number; sha256?: string }>;
}

/**
 * Reads a bundle, every piece held against its size and digest, every tensor against the layout.
 *
 * @throws BundleError a damaged, changed or foreign file, or one of a newer version.
 */
export async function readBundle(data: Uint8Array<ArrayBuffer>): Promise<Avatar> {
  const pieces = await unzip(data);
  const manifest = parsed(pieces.get("manifest.json"));
  if (manifest.version! > VERSION) {
    throw new BundleError("the avatar", `version ${VERSION} or older`, `version ${manifest.version}`,
      "open it with the player of the smplxpp that wrote it");
  }
  const unpacked = new Map<string, Piece>();
  for (const [name, { file = "", bytes, sha256: digest }] of Object.entries(manifest.pieces ?? {})) {
    const content = pieces.get(file);
    if (!content) throw new BundleError("the avatar", `a piece ${file}`, "none", EXPORT_AGAIN);
    if (content.length !== bytes || (await sha256(content)) !== digest) {
      throw new BundleError(`piece ${name}`, "the bytes that the manifest's digest is of",
        "others: the file is damaged or was changed", EXPORT_AGAIN);
    }
    unpacked.set(name, unpackTensors(content, `piece ${name}`));
  }
  const tensors = new Tensors(new Map([...unpacked].map(([name, piece]) => [name, piece.tensors])));
  const avatar = assembled(manifest, tensors, data.length), [motion, garments] = [unpacked.get("motion"), unpacked.get("garments")];
  if (motion) avatar.motion = readMotion(motion.tensors, avatar, tensors);
  if (garments) avatar.garments = readGarments(garments.tensors, garments.about, avatar, tensors);
  return avatar;
}

function parsed(text: Uint8Array | undefined): Manifest {
  let manifest: Manifest | undefined;
  try {
    manifest = text && (JSON.parse(new TextDecoder().decode(text)) as Manifest);
  } catch {
    // What is no JSON is no manifest.
  }
  if (manifest?.format !== FORMAT || !Number.isInteger(manifest.version)) {
    throw new BundleError("the file", "an avatar that smplxpp export wrote", "another archive", EXPORT_AGAIN);
  }
  return manifest;
}

function assembled(manifest: Manifest, t: Tensors, bytes: number): Avatar {
  const { J, E, V } = t.sizes, model = manifest.model ?? {};
  const parents = t.ints("skeleton.parents");
  const ordered = parents[0] === -1 && parents.every((parent, j) => j === 0 || (parent >= 0 && parent < j));
  if (!ordered) throw new BundleError("skeleton.parents", "every parent before its children", "another order", EXPORT_AGAIN);
  const names = (list: string[] | undefined, count: number, word: string) =>
    list?.length === count ? list.map(String) : Array.from({ length: count }, (_, k) => `${word} ${k + 1}`);
  const parts = t.ints("surface.parts"), partCount = parts.reduce((most, part) => Math.max(most, part), 0) + 1;
  const faces = t.ints("surface.faces");
  return {
    name: String(model.name ?? "avatar"),
    licence: String(model.licence ?? ""),
    provenance: model.provenance ?? {},
    partNames: names(model.part_names?.slice(0, partCount), partCount, "part"),
    expressionNames: names(model.expression_names, E, "expression"),
    blur: Number(model.eps2d ?? 0.1),
    skeleton: {
      names: names(model.joint_names, J, "joint"),
      parents,
      rest: t.floats("skeleton.joints"),
      byExpression: t.floats("skeleton.expression"),
    },
    mesh: {
      vertices: t.floats("surface.vertices"),
      faces,
      joints: t.ints("surface.joint_indices"),
      weights: normalised(t.floats("surface.joint_weights"), t.sizes.k),
      influences: t.sizes.k,
      parts,
      expressions: { rows: t.ints("surface.expression_rows"), basis: t.floats("surface.expression"), size: E },
      correctives: t.has("surface.pose") && t.has("surface.pose_rows") && t.sizes.P === 9 * (J - 1)
        ? { rows: t.ints("surface.pose_rows"), basis: t.floats("surface.pose"), size: t.sizes.P }
        : null,
    },
    field: t.has("field.points") ? field(t, Boolean(model.null_code_shown), V) : null,
    blendShapes: t.has("blend.head.values") ? blendShapes(t, Boolean(model.jaw)) : null,
    known: t.has("poses.known") ? { poses: t.floats("poses.known"), scale: t.floats("poses.scale")[0] } : null,
    gaussians: gaussians(t, faces, parts),
    garments: [],
    motion: null,
    bytes,
  };
}

function layer(t: Tensors, name: string, part = 0, of = 1): Layer {
  const weight = t.floats(`${name}.weight`), bias = t.floats(`${name}.bias`);
  const outputs = bias.length / of, inputs = weight.length / of / outputs;
  return {
    inputs, outputs,
    weight: weight.subarray(part * inputs * outputs, (part + 1) * inputs * outputs),
    bias: bias.subarray(part * outputs, (part + 1) * outputs),
  };
}

function hidden(t: Tensors, name: string, count: number): Layer[] {
  return Array.from({ length: count }, (_, k) => layer(t, name, k, count));
}

function field(t: Tensors, nullCodeShown: boolean, vertices: number): Field {
  const { Z, H, W, n } = t.sizes, points = t.floats("field.points");
  const network = (name: string): FieldNetwork => ({
    ofPoint: encodedPoints(points, t.floats(`field.${name}.of_point.weight`), W),
    ofFrame: layer(t, `field.${name}.of_frame`),
    hidden: hidden(t, `field.${name}.hidden`, H),
    last: layer(t, `field.${name}.last`),
  });
  const body = network("body");
  if (body.ofFrame.inputs !== 63 + Z || vertices * n !== t.ints("field.neighbours").length) {
    throw new BundleError("field", `${63 + Z} inputs`, `${body.ofFrame.inputs}`, EXPORT_AGAIN);
  }
  return {
    body,
    cloth: network("cloth"),
    clothPoints: t.ints("field.cloth"),
    // What training showed of poses without a frame: zero; else the first frame's code.
    code: nullCodeShown ? new Float32Array(Z) : t.floats("field.codes").slice(0, Z),
    sets: Float32Array.from(t.ints("field.sets")),
    setOf: t.ints("field.member"),
    neighbours: t.ints("field.neighbours"),
    weights: normalised(t.floats("field.weights"), n),
    neighbourCount: n,
    regression: t.has("regression.level")
      ? {
          level: t.floats("regression.level"), basis: t.floats("regression.basis"), size: t.sizes.a,
          rows: t.floats("regression.rows"), center: t.floats("regression.center"),
          low: t.floats("regression.low"), high: t.floats("regression.high"),
        }
      : null,
  };
}

function blendShapes(t: Tensors, jaw: boolean): BlendShapes {
  const side = (name: string): BlendSide => {
    const own = (tensor: string) => `blend.${name}.${tensor}`;
    const shapes = t.sizes[`${name}n`], rows = t.has(own("rows")) ? t.ints(own("rows")) : null;
    if (!rows && t.sizes[`${name}m`] !== t.sizes.N) {
      throw new BundleError(own("values"), `${t.sizes.N} rows`, `${t.sizes[`${name}m`]}`, EXPORT_AGAIN);
    }
    return {
      layers: [layer(t, own("first")), ...hidden(t, own("hidden"), t.sizes[`${name}h`]), layer(t, own("last"))],
      shapes, rows,
      values: t.steps(own("values")),
      step: t.has(own("step")) ? t.floats(own("step")) : null,
      exponent: t.has(own("exponent")) ? t.ints(own("exponent")) : null,
    };
  };
  const part = t.has("blend.part") ? t.ints("blend.part") : null;
  const [head, body] = [side("head"), side("body")];
  const most = part ? part.reduce((largest, one) => Math.max(largest, one), 0) + 1 : 1;
  for (const { layers, shapes } of [head, body]) {
    if (layers.at(-1)!.outputs < most * shapes) {
      throw new BundleError("blend", `${most} x ${shapes} coefficients`, `${layers.at(-1)!.outputs}`, EXPORT_AGAIN);
    }
  }
  return { head, body, jaw, part };
}

function gaussians(t: Tensors, faces: Int32Array, parts: Int32Array): Gaussians {
  const { N, K, F } = t.sizes;
  const perFace = t.ints("gaussians.per_face"), face = new Int32Array(N), part = new Uint8Array(N);
  const first = new Int32Array(F + 1);
  let filled = 0;
  for (let f = 0; f < F; ++f) {
    face.fill(f, filled, filled + perFace[f]);
    part.fill(parts[faces[3 * f]], filled, filled + perFace[f]);
    filled += perFace[f];
    first[f + 1] = filled;
  }
  if (filled !== N || perFace.some((count) => count < 0)) {
    throw new BundleError("gaussians.per_face", `counts of ${N}`, `${filled}`, EXPORT_AGAIN);
  }
  return {
    count: N, face, first, part,
    barycentric: t.floats("gaussians.barycentric"),
    offset: t.floats("gaussians.offset"),
    quats: t.floats("gaussians.quats"),
    scales: t.floats("gaussians.log_scales").map(Math.exp),
    thickness: THICKNESS,
    opacity: t.floats("gaussians.opacities"),
    color: t.floats("gaussians.dc"),
    harmonics: t.floats("gaussians.sh"),
    harmonicCount: K,
  };
}

/** Rows that sum to 1, as they do where they were not rounded. */
function normalised(rows: Float32Array, width: number): Float32Array {
  const out = new Float32Array(rows.length);
  for (let at = 0; at < rows.length; at += width) {
    let sum = 0;
    for (let k = 0; k < width; ++k) sum += rows[at + k];
    for (let k = 0; k < width; ++k) out[at + k] = rows[at + k] / Math.max(sum, 1e-12);
  }
  return out;
}
