"""Make the scan of a procedural person: dress her in the T-pose, pose her, scan and colour her."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel, PosedBody
from smplxpp.core import LABEL_BY_NAME, BodyParams, TriangleMesh, concatenate_meshes
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.people.bodies import Posing, betas_of, fitting_mannequin
from smplxpp.people.cast import Member, Wear
from smplxpp.people.cloth_mesh import ClothMesh, lift_outside, outer_faces, smooth
from smplxpp.people.garments.mannequin import ARM_JOINTS, HAND_JOINTS, shares
from smplxpp.people.garments.wardrobe import all_garments
from smplxpp.people.outside import heel_blocks, outside_body, seed_of
from smplxpp.people.paint import cloth_paint, hair_paint, photographed, skin_paint
from smplxpp.people.person_scan import PersonScan, face_majority
from smplxpp.people.scan_simulation import ScanConfig, SimulatedScan, merge_islands, simulate_scan
from smplxpp.people.textures import smooth_noise
from smplxpp.people.things import Thing, thing_mesh
from smplxpp.skinning import skin

_OVER_CLOTH = 0.003  # metres between layers
_SCAN = ScanConfig(cell=0.0055, views=48, resolution=896)


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of clothes in the T-pose at the person's own size.

    Attributes:
        wear: its description in the cast.
        label: id of its label.
        cloth: mesh with skinning weights.
        seed: seed of its folds and its pattern.
    """

    wear: Wear
    label: int
    cloth: ClothMesh
    seed: int


@dataclass(frozen=True, eq=False)
class Dressed:
    """A person in her clothes, in the T-pose.

    Attributes:
        body: the body model.
        betas: her shape coefficients.
        layers: her clothes from the inside out.
    """

    body: BodyModel
    betas: Float[np.ndarray, " B"]
    layers: list[Layer]


def make_person(
    name: str, member: Member, body: BodyModel, *, seed: int, scan: ScanConfig = _SCAN, thing: Thing | None = None
) -> PersonScan:
    """Make the scan of one member; another seed gives another person of that build, in that stance and dress.

    Args:
        name: of the member, which enters the seed.
        member: her description.
        body: the body model; hers has offsets from it where the member is outside its shapes.
        seed: of shape, pose, folds, patterns and noise.
        scan: settings of the simulated scan.
        thing: what she holds; its faces have the label "object".
    """
    # Dress her, then pose her as far along her stance as the clothes let her hands come.
    digest = hashlib.sha256(name.encode()).digest()
    rng = np.random.default_rng([seed, int.from_bytes(digest[:4], "little")])
    body = outside_body(body, member.outside, seed=seed_of(name, seed))
    dressed = dress(member, body, rng)
    facing = member.facing if seed == 0 else float(rng.uniform(-180.0, 180.0))
    posing = Posing.of(body, member.stance, dressed.betas, facing=facing, rng=rng)
    posing = replace(posing, added=member.outside.turns())
    params = posing.params(_reachable_share(dressed, posing))
    posed, sheets = pose_layers(dressed, params)
    # Put her on the floor, near the origin.
    low = min(points[:, 1].min() for points in (posed.vertices[0], *sheets))
    place = np.array([*rng.uniform(-0.3, 0.3, 1), -low, *rng.uniform(-0.3, 0.3, 1)])
    params = replace(params, transl=params.transl + place)

    # Scan all layers at once; each is drawn back under the layers over it.
    cloths = [one.cloth.mesh.with_vertices(p + place) for one, p in zip(dressed.layers, sheets, strict=True)]
    meshes: list[TriangleMesh] = []
    for mesh in (body.mesh(posed.vertices[0] + place), *cloths):
        meshes = [*(_kept_under(inner, mesh) for inner in meshes), mesh]
    sheets_end = len(meshes)
    if thing is not None:
        held = thing_mesh(thing, body, posed)
        meshes.append(held.with_vertices(held.vertices + place))
    owner = np.repeat(np.arange(len(meshes)), [mesh.face_count for mesh in meshes])
    layers = concatenate_meshes(meshes)
    taken = simulate_scan(
        layers,
        [owner == k for k in range(1, sheets_end)],
        replace(scan, detail_above=0.84 * float(np.ptp(layers.vertices[:, 1])), seed=int(rng.integers(2**31))),
    )
    # A vertex takes the label of the layer that it shows, small islands that of their surroundings.
    shown = owner[taken.face]
    merged = merge_islands(taken.mesh, shown.astype(np.uint8))
    ids = np.array([LABEL_BY_NAME["skin"].id, *(one.label for one in dressed.layers), LABEL_BY_NAME["object"].id])
    labels = ids[merged]
    colors = None
    if member.colored:
        # Where an island was relabelled, the colour comes from the nearest vertex that shows its own layer.
        albedo = _albedo(dressed, member, taken, shown, rng)
        if thing is not None:
            albedo[shown == sheets_end] = thing.color
        own = np.flatnonzero(merged == shown)
        albedo = albedo[own[cKDTree(taken.mesh.vertices[own]).query(taken.mesh.vertices)[1]]]
        colors = photographed(taken.mesh, albedo, rng=rng)
    # Vertices farther than 4 mm from every layer belong to bridges and filled holes.
    off = np.linalg.norm(taken.mesh.vertices - taken.shown_on(layers), axis=1)
    seen = (off < 0.004)[taken.mesh.faces].all(axis=1)
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
    """Cut the clothes on the person and put them on over each other, in the T-pose."""
    betas = betas_of(body, member.build, rng)
    mannequin, scale = fitting_mannequin(body, betas)
    garments = all_garments(mannequin)
    worn: list[Layer] = []
    for wear in member.wears:
        garment, seed = garments[wear.garment], int(rng.integers(2**31))
        cloth = _put_on(garment.make(), [one.cloth for one in worn], folds=wear.folds, seed=seed)
        worn.append(Layer(wear, LABEL_BY_NAME[garment.label].id, cloth, seed))
    sized = [replace(one, cloth=one.cloth.with_vertices(one.cloth.vertices * scale)) for one in worn]
    if member.outside.heels:
        shoes = next(one for one in sized if one.label == LABEL_BY_NAME["shoe"].id)
        rest = BodyParams.rest(betas=betas, expressions=body.num_expressions)
        sized.append(replace(shoes, cloth=heel_blocks(body, rest, member.outside)))
    return Dressed(body, betas, sized)


def _put_on(cloth: ClothMesh, worn: list[ClothMesh], *, folds: float, seed: int) -> ClothMesh:
    """Add folds of a height in metres, and push the cloth out of what is worn already."""
    mesh = cloth.mesh
    coarse = smooth_noise(cloth.vertices, scale=(0.03, 0.12, 0.03), seed=seed)
    fine = smooth_noise(cloth.vertices, scale=(0.02, 0.02, 0.03), seed=seed + 1)
    vertices = cloth.vertices + folds * (coarse + 0.5 * fine)[:, None] * mesh.vertex_normals
    for inner in worn:
        vertices = lift_outside(mesh.with_vertices(vertices), inner.mesh, clearance=_OVER_CLOTH, solid=False)
    return cloth.with_vertices(vertices)


def pose_layers(dressed: Dressed, params: BodyParams) -> tuple[PosedBody, list[Float[np.ndarray, "_ 3"]]]:
    """Return the posed body and the vertices of its layers, pushed out of the skin and of each other again."""
    posed = dressed.body.forward(params)
    bare = dressed.body.mesh(posed.vertices[0]).submesh(outer_faces(dressed.body))[0]
    out: list[np.ndarray] = []
    for layer in dressed.layers:
        mesh = layer.cloth.mesh.with_vertices(skin(layer.cloth.vertices, layer.cloth.weights, posed.posed_from_rest[0]))
        vertices = lift_outside(mesh, bare, clearance=0.0035, solid=True)
        for inner, points in zip(dressed.layers, out, strict=False):
            under = inner.cloth.mesh.with_vertices(points)
            vertices = lift_outside(mesh.with_vertices(vertices), under, clearance=_OVER_CLOTH, solid=False, reach=0.02)
        out.append(smooth(mesh, vertices, steps=1))
    return posed, out


def _kept_under(inner: TriangleMesh, outer: TriangleMesh) -> TriangleMesh:
    """Draw a layer back where another lies on it, so that the noise of a scan does not bring it to light."""
    hidden = 0.006  # metres that it keeps under the other
    if not outer.face_count:
        return inner
    where = SignedDistanceField(outer, solid=False).query(inner.vertices)
    beneath = ~where.on_border & (np.abs(where.distance) < hidden)
    beneath &= np.einsum("ij,ij->i", where.normal, inner.vertex_normals) > 0.3
    back = np.where(beneath, where.distance + hidden, 0.0)
    return inner.with_vertices(inner.vertices - back[:, None] * where.normal)


def _reachable_share(dressed: Dressed, posing: Posing) -> float:
    """Return the share of a stance's path at which arms stop before body or clothes; 1 where nothing is touched."""
    body = dressed.body
    arms = [
        np.flatnonzero(shares(body, body.weights, tuple(f"{side}_{part}" for part in HAND_JOINTS)) > 0.9)
        for side in posing.stance.touching
    ]
    if not arms:
        return 1.0
    # Advance in 14 steps; hands nearer than 12 mm would fuse with the body in a noisy scan.
    chosen = 0.0
    for share in np.linspace(0.0, 1.0, 15)[1:]:
        posed = body.forward(posing.params(float(share)))
        points, faces = _without_arms(dressed, posed)
        reached = posed.vertices[0][np.concatenate(arms)]
        if igl.point_mesh_squared_distance(reached, points, faces)[0].min() < 0.012**2:
            break
        chosen = float(share)
    return chosen


def _without_arms(dressed: Dressed, posed: PosedBody) -> tuple[np.ndarray, Int[np.ndarray, "M 3"]]:
    """Return posed body and layers as one mesh, without what follows the arms."""
    body = dressed.body
    pieces = [(posed.vertices[0], body.faces, body.weights)]
    for layer in dressed.layers:
        cloth = layer.cloth
        pieces.append((skin(cloth.vertices, cloth.weights, posed.posed_from_rest[0]), cloth.faces, cloth.weights))
    meshes = [
        TriangleMesh(vertices, faces[(shares(body, weights, ARM_JOINTS) < 0.4)[faces].all(axis=1)])
        for vertices, faces, weights in pieces
    ]
    whole = concatenate_meshes(meshes)
    return whole.vertices, whole.faces


def _albedo(
    dressed: Dressed, member: Member, taken: SimulatedScan, shown: Int[np.ndarray, " N"], rng: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    """Return the unlit colour (0 to 255) of what each vertex shows, by its place on the T-pose."""
    body = dressed.body
    rest = body.forward(BodyParams.rest(betas=dressed.betas, expressions=body.num_expressions))
    sewn = concatenate_meshes([body.mesh(rest.vertices[0]), *(o.cloth.mesh for o in dressed.layers)])
    worn = shown <= len(dressed.layers)
    points = np.zeros((len(shown), 3))
    points[worn] = np.einsum("pk,pkx->px", taken.barycentric[worn], sewn.triangles[taken.face[worn]])
    out = np.zeros((len(points), 3))
    # Skin and eyeballs are layer 0.
    own = shown == 0
    eyes = np.array([rest.joints[0][body.joint_names.index(f"{side}_eye_smplhf")] for side in ("left", "right")])
    part = body.part_labels[body.faces[taken.face[own], 0]]
    eyeball = np.array(["eye" in name for name in body.part_label_names])[part]
    seed = int(rng.integers(2**31))
    out[own] = skin_paint(points[own], eyes, eyeball, tone=member.tone, betas=dressed.betas, seed=seed)
    for k, layer in enumerate(dressed.layers, start=1):
        own, dye = shown == k, layer.wear.dye
        if layer.label == LABEL_BY_NAME["hair"].id:
            out[own] = hair_paint(points[own], dye.color, seed=layer.seed)
        else:
            out[own] = cloth_paint(points[own], dye, seed=layer.seed)
    return out
