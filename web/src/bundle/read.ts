/** A bundle, `NAME.avatar`, to an avatar that can be posed. */

import type { Avatar, BlendShapes, BlendSide, Field, FieldNetwork, Gaussians, Layer } from "../avatar/avatar.ts";
import { encodedPoints } from "../avatar/networks.ts";
import { UNTOLD } from "../cloth/simulation.ts";
import { checkConsistency, readAbout, type About } from "./consistency.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import { readGarments, readSimulation } from "./garments.ts";
import { asInteger, asObject, asText, parseJson } from "./json.ts";
import { PIECES, Tensors } from "./layout.ts";
import { readMotion } from "./motion.ts";
import { sha256 } from "./sha256.ts";
import { unpackTensors, type Piece } from "./tensors.ts";
import { unzip } from "./zip.ts";

const FORMAT = "smplxpp-avatar", VERSION = 2;
const KNOWN = [...Object.keys(PIECES), "garments", "motion"];
/** Scale of every Gaussian along its normal, in mean edge lengths of its triangle. */
const THICKNESS = 0.01;

/**
 * Reads a bundle, every piece held against its size and digest, every tensor against the layout.
 *
 * @throws BundleError a damaged, changed or foreign file, or one of a newer version.
 */
export async function readBundle(data: Uint8Array<ArrayBuffer>): Promise<Avatar> {
  const files = await unzip(data), manifest = readManifest(files.get("manifest.json"));
  files.delete("manifest.json");
  const pieces = await readPieces(manifest.pieces, files);
  const about = readAbout(manifest.model), tensors = new Tensors(pieces);
  checkConsistency(about, tensors);
  const avatar = assembled(about, tensors, data.length), [motion, garments] = [pieces.get("motion"), pieces.get("garments")];
  if (motion?.tensors.size) avatar.motion = readMotion(motion.tensors, avatar, tensors);
  if (garments?.tensors.size) {
    avatar.garments = readGarments(garments.tensors, garments.about, avatar, tensors);
    avatar.simulation = readSimulation(garments.about);
  }
  return avatar;
}

function readManifest(text: Uint8Array | undefined): Record<string, unknown> {
  const manifest = text && asObject(parseJson(text, "manifest"), "manifest");
  if (manifest?.format !== FORMAT) throw new BundleError("the file", "an avatar that smplxpp export wrote", "another archive", EXPORT_AGAIN);
  const version = asInteger(manifest.version, "version", 1);
  if (version > VERSION) {
    throw new BundleError("the avatar", `version ${VERSION} or older`, `version ${version}`, "open it with the player of the smplxpp that wrote it");
  }
  return manifest;
}

/** The pieces of the manifest, each a known one and of its size and digest, and no file beside them. */
async function readPieces(listed: unknown, files: Map<string, Uint8Array<ArrayBuffer>>): Promise<Map<string, Piece>> {
  const pieces = new Map<string, Piece>(), beside = new Set(files.keys());
  for (const [name, value] of Object.entries(asObject(listed, "pieces"))) {
    const { file, bytes, sha256: digest } = asObject(value, `piece ${name}`), content = files.get(asText(file, `piece ${name}`));
    if (!content || !KNOWN.includes(name)) {
      throw new BundleError(`piece ${name}`, "one of its version, in the file", content ? "another" : "none", EXPORT_AGAIN);
    }
    if (content.length !== bytes || (await sha256(content)) !== digest) {
      throw new BundleError(`piece ${name}`, "the bytes that the manifest's digest is of", "others: the file is damaged or was changed", EXPORT_AGAIN);
    }
    beside.delete(file as string);
    pieces.set(name, unpackTensors(content, `piece ${name}`));
  }
  if (beside.size) throw new BundleError("the avatar", "the pieces of its manifest alone", `${[...beside].sort()[0]} beside them`, EXPORT_AGAIN);
  return pieces;
}

function assembled(about: About, t: Tensors, bytes: number): Avatar {
  const { E } = t.sizes;
  const parts = t.ints("surface.parts"), partCount = parts.reduce((most, part) => Math.max(most, part), 0) + 1;
  const faces = t.ints("surface.faces");
  return {
    name: about.name,
    licence: about.licence,
    provenance: about.provenance,
    partNames: about.partNames.slice(0, partCount),
    expressionNames: about.expressionNames,
    blur: about.blur,
    skeleton: {
      names: about.jointNames,
      parents: t.ints("skeleton.parents"),
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
      correctives: t.has("surface.pose")
        ? { rows: t.ints("surface.pose_rows"), basis: t.floats("surface.pose"), size: t.sizes.P }
        : null,
    },
    field: t.has("field.points") ? field(t, about.nullCodeShown) : null,
    blendShapes: t.has("blend.head.values") ? blendShapes(t, about.jaw) : null,
    known: t.has("poses.known") ? { poses: t.floats("poses.known"), scale: t.floats("poses.scale")[0] } : null,
    gaussians: gaussians(t, faces, parts),
    garments: [],
    simulation: UNTOLD,
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

function field(t: Tensors, nullCodeShown: boolean): Field {
  const { Z, H, W, n } = t.sizes, points = t.floats("field.points");
  const network = (name: string): FieldNetwork => ({
    ofPoint: encodedPoints(points, t.floats(`field.${name}.of_point.weight`), W),
    ofFrame: layer(t, `field.${name}.of_frame`),
    hidden: hidden(t, `field.${name}.hidden`, H),
    last: layer(t, `field.${name}.last`),
  });
  return {
    body: network("body"),
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
    return {
      layers: [layer(t, own("first")), ...hidden(t, own("hidden"), t.sizes[`${name}h`]), layer(t, own("last"))],
      shapes, rows,
      values: t.steps(own("values")),
      step: t.has(own("step")) ? t.floats(own("step")) : null,
      exponent: t.has(own("exponent")) ? t.ints(own("exponent")) : null,
    };
  };
  const part = t.has("blend.part") ? t.ints("blend.part") : null;
  return { head: side("head"), body: side("body"), jaw, part };
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
    bare: t.has("gaussians.bare_offset")
      ? {
          covered: t.ints("gaussians.covered"), offset: t.floats("gaussians.bare_offset"), quats: t.floats("gaussians.bare_quats"),
          scale: t.floats("gaussians.bare_scale"), color: t.floats("gaussians.bare_dc"),
        }
      : null,
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
