"""All garments on one person, and each as a scan shows it: in some pose, noisy, simplified."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float

from benchmarks.garments.cut import Garment
from benchmarks.garments.fitted import fitted_garments
from benchmarks.garments.hair import hairstyles
from benchmarks.garments.loose import loose_garments
from benchmarks.garments.mannequin import Mannequin, shares
from pipelines.synth.noise import smooth_noise
from smplxpp.body import BodyModel
from smplxpp.clean.simplify import simplify
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.skinning import skin

SHAPES = ("mean", "heavy and tall", "slight")
POSES = ("T", "A", "hands")
_A_POSE = 50.0  # degrees that the arms are lowered
_STEEPEST, _STEP = 82.0, 4.0
_GAP = 0.004  # between hands and cloth
_KEPT = 0.6  # of the faces
_HANDS = ("elbow", "wrist", "index", "middle", "pinky", "ring", "thumb")


@dataclass(frozen=True, eq=False)
class Case:
    """A garment on a person in a pose.

    Attributes:
        garment: in the T-pose. shape, pose: names.
        mesh: as scanned. weights: (N, J) authored. rest_vertices: (N, 3) in the T-pose.
        source: the posed body. params: of the pose; its identity is the person's.
    """

    garment: Garment
    shape: str
    pose: str
    mesh: TriangleMesh
    weights: Float[np.ndarray, "N J"]
    rest_vertices: Float[np.ndarray, "N 3"]
    source: TriangleMesh
    params: BodyParams


def betas_of(body: BodyModel, shape: str) -> np.ndarray:
    """Coefficients of one of `SHAPES`."""
    betas = np.zeros(body.num_betas)
    if shape != "mean":
        rng = np.random.default_rng(SHAPES.index(shape))
        betas = rng.normal(size=body.num_betas) * 0.6
        betas[:2] = (1.3, 1.2) if shape == "heavy and tall" else (-1.2, -0.8)
    return betas


def garments_of(mannequin: Mannequin) -> list[Garment]:
    """Every garment of the bench."""
    return [*fitted_garments(mannequin), *loose_garments(mannequin), *hairstyles(mannequin)]


def cases(body: BodyModel, shape: str, *, poses: tuple[str, ...] = POSES) -> Iterator[Case]:
    """Every garment on a person of one shape in every pose; "hands" for those that arms may hang beside."""
    mannequin = Mannequin.of(body, betas_of(body, shape))
    for k, garment in enumerate(garments_of(mannequin)):
        for pose in poses:
            if pose != "hands" or garment.beside_hands:
                yield scan(mannequin, garment, shape, pose, seed=k)


def scan(mannequin: Mannequin, garment: Garment, shape: str, pose: str, *, seed: int) -> Case:
    """One garment as scanned in a pose of `POSES`; in the T-pose as it was made."""
    cloth = garment.cloth
    if pose == "T":
        source = mannequin.body.mesh(mannequin.body.forward(mannequin.params).vertices[0])
        return Case(garment, shape, pose, cloth.mesh, cloth.weights, cloth.vertices, source, mannequin.params)
    params = lowered(mannequin, _A_POSE) if pose == "A" else _hands_beside(mannequin, garment)
    posed = mannequin.body.forward(params)
    mesh = cloth.mesh.with_vertices(skin(cloth.vertices, cloth.weights, posed.posed_from_rest[0]))
    folds = smooth_noise(mesh.vertices, scale=(0.02, 0.05, 0.02), seed=seed)
    grain = np.random.default_rng(seed).normal(size=mesh.vertex_count)
    scanned = mesh.with_vertices(mesh.vertices + (0.0012 * folds + 0.0004 * grain)[:, None] * mesh.vertex_normals)
    kept = simplify(scanned, int(_KEPT * scanned.face_count))
    # A simplified vertex stands for a vertex of the scan: it takes that one's place, so that the truth is exact there.
    index = kept.source_vertex
    return Case(
        garment,
        shape,
        pose,
        kept.mesh.with_vertices(scanned.vertices[index]),
        cloth.weights[index],
        cloth.vertices[index],
        mannequin.body.mesh(posed.vertices[0]),
        params,
    )


def lowered(mannequin: Mannequin, degrees: float) -> BodyParams:
    """The person with lowered arms, elbows a little bent and feet a step apart, face and hands at rest."""
    pose = np.zeros((1, 55, 3))
    names = mannequin.body.joint_names
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[0, names.index(f"{side}_collar"), 2] = 0.12 * sign * degrees
        pose[0, names.index(f"{side}_shoulder"), 2] = 0.88 * sign * degrees
        pose[0, names.index(f"{side}_elbow"), 1] = 8.0 * sign
        pose[0, names.index(f"{side}_hip"), 2] = -4.0 * sign
    p = mannequin.params
    return BodyParams.from_full_pose(np.radians(pose), betas=p.betas, expression=p.expression, transl=p.transl)


def _hands_beside(mannequin: Mannequin, garment: Garment) -> BodyParams:
    """The person with the arms as low as they come before forearm or hand touch the cloth."""
    arm = shares(mannequin.body, mannequin.body.weights, _HANDS) > 0.9
    chosen = lowered(mannequin, 0.0)
    for degrees in np.arange(_STEP, _STEEPEST + 1e-9, _STEP):
        params = lowered(mannequin, float(degrees))
        posed = mannequin.body.forward(params)
        points = skin(garment.cloth.vertices, garment.cloth.weights, posed.posed_from_rest[0])
        squared = igl.point_mesh_squared_distance(posed.vertices[0][arm], points, garment.cloth.faces)[0]
        if squared.min() < _GAP**2:
            break
        chosen = params
    return chosen
