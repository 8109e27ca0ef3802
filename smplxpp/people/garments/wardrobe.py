"""Every garment by name, and each as a scan shows it on a person: posed, noisy, simplified."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float

from smplxpp.body import BodyModel
from smplxpp.clean.simplify import simplify
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.people.garments.cut import Garment
from smplxpp.people.garments.draped import draped_garments, hooded_cape
from smplxpp.people.garments.fitted import bottoms, fitted_garments, tops, worn_things
from smplxpp.people.garments.hair import beads, beards, hairstyles, tied_and_short_hair
from smplxpp.people.garments.loose import layered_garments, loose_garments, peplum_blouse
from smplxpp.people.garments.mannequin import ARMS_DOWN, HAND_JOINTS, Mannequin, lowered, shares
from smplxpp.people.textures import smooth_noise
from smplxpp.skinning import skin

SHAPES = ("mean", "heavy and tall", "slight")
POSES = ("T", "A", "hands")


@dataclass(frozen=True, eq=False)
class Case:
    """A garment on a person in a pose.

    Attributes:
        garment: the garment in the T-pose.
        shape: one of `SHAPES`.
        pose: one of `POSES`.
        mesh: the garment as scanned.
        weights: authored skinning weights of the scan's vertices.
        rest_vertices: the same vertices in the T-pose, metres.
        source: the posed body.
        params: parameters of the posed body.
    """

    garment: Garment
    shape: str
    pose: str
    mesh: TriangleMesh
    weights: Float[np.ndarray, "N J"]
    rest_vertices: Float[np.ndarray, "N 3"]
    source: TriangleMesh
    params: BodyParams


def shape_betas(body: BodyModel, shape: str) -> np.ndarray:
    """Return the shape coefficients of one of `SHAPES`."""
    betas = np.zeros(body.num_betas)
    if shape != "mean":
        rng = np.random.default_rng(SHAPES.index(shape))
        betas = rng.normal(size=body.num_betas) * 0.6
        betas[:2] = (1.3, 1.2) if shape == "heavy and tall" else (-1.2, -0.8)
    return betas


def garments_of(mannequin: Mannequin) -> list[Garment]:
    """Return the garments of the transfer benchmark in their fixed order, which seeds their scans' noise."""
    return [
        *fitted_garments(mannequin),
        *loose_garments(mannequin),
        *hairstyles(mannequin),
        *draped_garments(mannequin),
        *layered_garments(mannequin),
        *worn_things(mannequin),
        *beards(mannequin),
        peplum_blouse(mannequin),
        hooded_cape(mannequin),
        beads(mannequin),
    ]


def all_garments(mannequin: Mannequin) -> dict[str, Garment]:
    """Return every garment and hairstyle by name, with those that only procedural people wear."""
    more = (*tops(mannequin), *bottoms(mannequin), *tied_and_short_hair(mannequin))
    return {garment.name: garment for garment in (*garments_of(mannequin), *more)}


def cases(body: BodyModel, shape: str, *, poses: tuple[str, ...] = POSES) -> Iterator[Case]:
    """Yield every garment on a person of one shape in every pose; "hands" for those that arms may hang beside."""
    mannequin = Mannequin.of(body, shape_betas(body, shape))
    for k, garment in enumerate(garments_of(mannequin)):
        for pose in poses if garment.pose is None else (garment.pose,):
            if pose != "hands" or garment.beside_hands:
                yield scan(mannequin, garment, shape, pose, seed=k)


def scan(mannequin: Mannequin, garment: Garment, shape: str, pose: str, *, seed: int) -> Case:
    """Return one garment as scanned in a pose of `POSES`; in the T-pose as it was made."""
    cloth = garment.cloth
    if pose == "T":
        source = mannequin.body.mesh(mannequin.body.forward(mannequin.params).vertices[0])
        return Case(garment, shape, pose, cloth.mesh, cloth.weights, cloth.vertices, source, mannequin.params)
    degrees = {"A": 50.0, "down": ARMS_DOWN}.get(pose)
    params = _hands_beside(mannequin, garment) if degrees is None else lowered(mannequin, degrees)
    posed = mannequin.body.forward(params)
    mesh = cloth.mesh.with_vertices(skin(cloth.vertices, cloth.weights, posed.posed_from_rest[0]))
    # A scan adds folds of 1.2 mm and grain of 0.4 mm along the normals, and keeps 60 % of the faces.
    folds = smooth_noise(mesh.vertices, scale=(0.02, 0.05, 0.02), seed=seed)
    grain = np.random.default_rng(seed).normal(size=mesh.vertex_count)
    scanned = mesh.with_vertices(mesh.vertices + (0.0012 * folds + 0.0004 * grain)[:, None] * mesh.vertex_normals)
    kept = simplify(scanned, int(0.6 * scanned.face_count))
    # Each vertex is moved back to the scan's vertex that it stands for, so that its true weights are exact.
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


def _hands_beside(mannequin: Mannequin, garment: Garment) -> BodyParams:
    """Return a pose with the arms as low as possible with 4 mm between cloth and forearms or hands."""
    arm = shares(mannequin.body, mannequin.body.weights, HAND_JOINTS) > 0.9
    chosen = lowered(mannequin, 0.0)
    for degrees in np.arange(4.0, 82.0 + 1e-9, 4.0):
        params = lowered(mannequin, float(degrees))
        posed = mannequin.body.forward(params)
        points = skin(garment.cloth.vertices, garment.cloth.weights, posed.posed_from_rest[0])
        squared = igl.point_mesh_squared_distance(posed.vertices[0][arm], points, garment.cloth.faces)[0]
        if squared.min() < 0.004**2:
            break
        chosen = params
    return chosen
