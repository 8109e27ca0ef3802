"""A person made: dressed in the T-pose, posed, scanned and coloured."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from benchmarks.garments.mannequin import shares
from benchmarks.people.builds import betas_of, fitting_mannequin
from benchmarks.people.cast import Member, Wear
from benchmarks.people.paint import cloth_paint, hair_paint, photographed, skin_paint
from benchmarks.people.person_scan import PersonScan, face_majority
from benchmarks.people.stances import Posing
from benchmarks.people.tailor import all_cuts
from pipelines.synth.cloth_mesh import ClothMesh, push_out, smooth
from pipelines.synth.noise import smooth_noise
from pipelines.synth.scan_simulation import ScanConfig, SimulatedScan, merge_islands, simulate_scan
from smplxpp.body import BodyModel, PosedBody
from smplxpp.core.labels import LABEL_BY_NAME
from smplxpp.core.mesh import TriangleMesh, concatenate_meshes
from smplxpp.core.params import BodyParams
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.skinning import skin

_OVER_CLOTH, _OVER_SKIN = 0.003, 0.0035  # metres between layers
_TRIES = 15  # of how far a hand comes before it touches
_GAP = 0.012  # metres between a hand and what it stops at: noisy surfaces nearer than this fuse
_TRUE = 0.004  # a scan's vertex farther than this from every layer shows none
_HIDDEN = 0.006  # what is scanned keeps this far under clothes: noise must not bring skin to light
_SCAN = ScanConfig(cell=0.0055, views=48, resolution=896)


@dataclass(frozen=True, eq=False)
class Layer:
    """What is worn, in the T-pose at the person's own size. `label` is an id; `seed` that of its pattern."""

    wear: Wear
    label: int
    cloth: ClothMesh
    seed: int


@dataclass(frozen=True, eq=False)
class Dressed:
    """A person in her clothes: body model, shape, layers from the inside out."""

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    layers: list[Layer]


def make_person(name: str, member: Member, body: BodyModel, *, seed: int, scan: ScanConfig = _SCAN) -> PersonScan:
    """Make the scan of one member; another seed gives another person of that build, in that stance and dress."""
    digest = hashlib.sha256(name.encode()).digest()
    rng = np.random.default_rng([seed, int.from_bytes(digest[:4], "little")])
    dressed = dress(member, body, rng)
    facing = member.facing if seed == 0 else float(rng.uniform(-180.0, 180.0))
    posing = Posing.of(body, member.stance, dressed.betas, facing=facing, rng=rng)
    params = posing.params(_share_of_way(dressed, posing))
    posed, sheets = pose_layers(dressed, params)
    # She stands on the floor, about the middle.
    low = min(points[:, 1].min() for points in (posed.vertices[0], *sheets))
    place = np.array([*rng.uniform(-0.3, 0.3, 1), -low, *rng.uniform(-0.3, 0.3, 1)])
    params = replace(params, transl=params.transl + place)

    cloths = [one.cloth.mesh.with_vertices(p + place) for one, p in zip(dressed.layers, sheets, strict=True)]
    meshes: list[TriangleMesh] = []
    for mesh in (body.mesh(posed.vertices[0] + place), *cloths):
        meshes = [*(_kept_under(inner, mesh) for inner in meshes), mesh]
    owner = np.repeat(np.arange(len(meshes)), [mesh.face_count for mesh in meshes])
    layers = concatenate_meshes(meshes)
    taken = simulate_scan(
        layers,
        [owner == k for k in range(1, len(meshes))],
        replace(scan, detail_above=0.84 * float(np.ptp(layers.vertices[:, 1])), seed=int(rng.integers(2**31))),
    )
    shown = owner[taken.face]
    merged = merge_islands(taken.mesh, shown.astype(np.uint8))
    ids = np.array([LABEL_BY_NAME["skin"].id, *(one.label for one in dressed.layers)])
    labels = ids[merged]
    colors = None
    if member.colored:
        albedo = _albedo(dressed, member, taken, shown, rng)
        own = np.flatnonzero(merged == shown)
        albedo = albedo[own[cKDTree(taken.mesh.vertices[own]).query(taken.mesh.vertices)[1]]]
        colors = photographed(taken.mesh, albedo, rng=rng)
    seen = _shows_a_layer(layers, taken)[taken.mesh.faces].all(axis=1)
    return PersonScan.of(
        body,
        params,
        name=name,
        mesh=taken.mesh,
        colors=colors,
        face_labels=face_majority(labels, taken.mesh.faces),
        seen=seen,
    )


def dress(member: Member, body: BodyModel, rng: np.random.Generator) -> Dressed:
    """Cut the clothes on the person and put them on one over the other, in the T-pose."""
    betas = betas_of(body, member.build, rng)
    mannequin, scale = fitting_mannequin(body, betas)
    cuts = all_cuts(mannequin)
    worn: list[Layer] = []
    for wear in member.wears:
        cut, seed = cuts[wear.cut], int(rng.integers(2**31))
        cloth = _put_on(cut.make(), [one.cloth for one in worn], folds=wear.folds, seed=seed)
        worn.append(Layer(wear, LABEL_BY_NAME[cut.label].id, cloth, seed))
    sized = [replace(one, cloth=one.cloth.with_vertices(one.cloth.vertices * scale)) for one in worn]
    return Dressed(body, betas, sized)


def _put_on(cloth: ClothMesh, worn: list[ClothMesh], *, folds: float, seed: int) -> ClothMesh:
    """Fold it and push it out of what is worn already."""
    mesh = cloth.mesh
    coarse = smooth_noise(cloth.vertices, scale=(0.03, 0.12, 0.03), seed=seed)
    fine = smooth_noise(cloth.vertices, scale=(0.02, 0.02, 0.03), seed=seed + 1)
    vertices = cloth.vertices + folds * (coarse + 0.5 * fine)[:, None] * mesh.vertex_normals
    for inner in worn:
        vertices = push_out(mesh.with_vertices(vertices), inner.mesh, clearance=_OVER_CLOTH, solid=False)
    return cloth.with_vertices(vertices)


def pose_layers(dressed: Dressed, params: BodyParams) -> tuple[PosedBody, list[Float[np.ndarray, "N 3"]]]:
    """The posed body and the vertices of its layers, pushed out of the skin and of each other again."""
    posed = dressed.body.forward(params)
    whole = (dressed.body.part_labels == 0)[dressed.body.faces].all(axis=1)
    bare = dressed.body.mesh(posed.vertices[0]).submesh(whole)[0]
    out: list[np.ndarray] = []
    for layer in dressed.layers:
        mesh = layer.cloth.mesh.with_vertices(skin(layer.cloth.vertices, layer.cloth.weights, posed.posed_from_rest[0]))
        vertices = push_out(mesh, bare, clearance=_OVER_SKIN, solid=True)
        for inner, points in zip(dressed.layers, out, strict=False):
            under = inner.cloth.mesh.with_vertices(points)
            vertices = push_out(mesh.with_vertices(vertices), under, clearance=_OVER_CLOTH, solid=False, reach=0.02)
        out.append(smooth(mesh, vertices, steps=1))
    return posed, out


def _kept_under(inner: TriangleMesh, outer: TriangleMesh) -> TriangleMesh:
    """What is scanned of a layer beneath another: drawn back where the other lies on it."""
    if not outer.face_count:
        return inner
    where = SignedDistanceField(outer, solid=False).query(inner.vertices)
    beneath = ~where.on_border & (np.abs(where.distance) < _HIDDEN)
    beneath &= np.einsum("ij,ij->i", where.normal, inner.vertex_normals) > 0.3
    back = np.where(beneath, where.distance + _HIDDEN, 0.0)
    return inner.with_vertices(inner.vertices - back[:, None] * where.normal)


def _share_of_way(dressed: Dressed, posing: Posing) -> float:
    """How far arms come before they touch body or clothes; 1 for stances that touch nothing."""
    body = dressed.body
    arms = [
        np.flatnonzero(shares(body, body.weights, tuple(f"{side}_{part}" for part in _HAND)) > 0.9)
        for side in posing.stance.touching
    ]
    if not arms:
        return 1.0
    chosen = 0.0
    for share in np.linspace(0.0, 1.0, _TRIES)[1:]:
        posed = body.forward(posing.params(float(share)))
        points, faces = _without_arms(dressed, posed)
        reached = posed.vertices[0][np.concatenate(arms)]
        if igl.point_mesh_squared_distance(reached, points, faces)[0].min() < _GAP**2:
            break
        chosen = float(share)
    return chosen


_HAND = ("elbow", "wrist", "index", "middle", "pinky", "ring", "thumb")
_ARM = ("shoulder", *_HAND)


def _without_arms(dressed: Dressed, posed: PosedBody) -> tuple[np.ndarray, Int[np.ndarray, "M 3"]]:
    """Posed body and layers without what follows the arms."""
    body = dressed.body
    pieces = [(posed.vertices[0], body.faces, body.weights)]
    for layer in dressed.layers:
        cloth = layer.cloth
        pieces.append((skin(cloth.vertices, cloth.weights, posed.posed_from_rest[0]), cloth.faces, cloth.weights))
    meshes = [
        TriangleMesh(vertices, faces[(shares(body, weights, _ARM) < 0.4)[faces].all(axis=1)])
        for vertices, faces, weights in pieces
    ]
    whole = concatenate_meshes(meshes)
    return whole.vertices, whole.faces


def _albedo(
    dressed: Dressed, member: Member, taken: SimulatedScan, shown: Int[np.ndarray, " N"], rng: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    """The colour of what each vertex shows, without light."""
    rest = dressed.body.forward(BodyParams.rest(betas=dressed.betas, expressions=dressed.body.num_expressions))
    body = dressed.body.mesh(rest.vertices[0])
    meshes = [body, *(one.cloth.mesh for one in dressed.layers)]
    corners = concatenate_meshes(meshes).triangles[taken.face]
    points = np.einsum("pk,pkx->px", taken.barycentric, corners)
    out = np.zeros((len(points), 3))
    for k in range(len(meshes)):
        own = shown == k
        if k:
            layer, dye = dressed.layers[k - 1], dressed.layers[k - 1].wear.dye
            is_hair = layer.label == LABEL_BY_NAME["hair"].id
            paint = (
                hair_paint(points[own], dye.color, seed=layer.seed)
                if is_hair
                else cloth_paint(points[own], dye, seed=layer.seed)
            )
            out[own] = paint
            continue
        eyes = np.array([rest.joints[0][dressed.body.joint_names.index(f"{side}_eye_smplhf")] for side in _SIDES])
        part = dressed.body.part_labels[dressed.body.faces[taken.face[own], 0]]
        eyeball = np.array(["eye" in name for name in dressed.body.part_label_names])[part]
        out[own] = skin_paint(
            points[own], eyes, eyeball, tone=member.tone, betas=dressed.betas, seed=int(rng.integers(2**31))
        )
    return out


_SIDES = ("left", "right")


def _shows_a_layer(layers: TriangleMesh, taken: SimulatedScan) -> Bool[np.ndarray, " N"]:
    """Tell the vertices that lie on a layer from those of webs and of what the scanner guessed."""
    points = np.einsum("pk,pkx->px", taken.barycentric, layers.triangles[taken.face])
    return np.linalg.norm(taken.mesh.vertices - points, axis=1) < _TRUE
