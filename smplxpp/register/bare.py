"""Which of the body's vertices are bare skin: seen so by labelled scans and label maps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core.camera import Camera
from smplxpp.core.labels import SKIN
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.spread import spread
from smplxpp.raster import rasterize_mesh
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics
from smplxpp.register.observations import Observations, ScanObservation

_REACH = 0.03
_FACING = 0.3
_MAPPED_FRAMES = 6
_BACKGROUND = 255
# Share of votes for skin, and least votes.
_SHARE, _LEAST = 0.75, 1.0


def bare_vertices(
    kinematics: Kinematics, state: BodyState, observed: Observations, frames: list[int], points: BodyPoints
) -> Bool[np.ndarray, " V"] | None:
    """Vertices that are skin in scans and label maps, and so is all around them; None where no labels were seen.

    Args:
        state: near the truth, a row for each of `frames`.
        points: all vertices of the body.
    """
    body = kinematics.body
    votes = np.zeros((body.vertex_count, 2))
    for row, frame in enumerate(frames):
        scan = observed.scans.get(frame)
        if scan is not None and scan.labels is not None:
            mesh = body.mesh(kinematics.points(points, kinematics.posture(state, row)))
            votes += _votes_of_scan(mesh, scan)
    if observed.labels is not None:
        mapped = [row for row, frame in enumerate(frames) if _has_map(observed, frame)]
        for row in spread(mapped, _MAPPED_FRAMES):
            mesh = body.mesh(kinematics.points(points, kinematics.posture(state, row)))
            for name, camera in observed.cameras.items():
                labels = observed.labels(name, frames[row])
                if labels is not None:
                    votes += _votes_of_map(mesh, camera, labels)
    return _bare(body, votes) if votes.any() else None


def _bare(body: BodyModel, votes: Float64[np.ndarray, "V 2"]) -> Bool[np.ndarray, " V"]:
    """Vertices whose votes are for skin, inside of what is."""
    total = votes.sum(axis=1)
    return _eroded(body, (total >= _LEAST) & (votes[:, 0] > _SHARE * np.maximum(total, 1e-9)))


def bare_of_scan(body: BodyModel, params: BodyParams, scan: ScanObservation) -> Bool[np.ndarray, " V"]:
    """Vertices of a body that a labelled scan shows to be skin, and so is all around them.

    Args:
        params: one row, the body in the scan.
    """
    votes = _votes_of_scan(body.mesh(body.forward(params).vertices[0]), scan)
    return _bare(body, votes)


def hands_of(body: BodyModel) -> Bool[np.ndarray, " V"]:
    """Vertices of the hands: what is mostly bare where no labels say it."""
    names = np.array(body.joint_names)
    fingers = np.array([any(f in n for f in ("index", "middle", "ring", "pinky", "thumb")) for n in names])
    return body.weights[:, fingers].sum(axis=1) > 0.3


def _has_map(observed: Observations, frame: int) -> bool:
    assert observed.labels is not None
    return any(observed.labels(name, frame) is not None for name in list(observed.cameras)[:3])


def _votes_of_scan(mesh: TriangleMesh, scan: ScanObservation) -> Float64[np.ndarray, "V 2"]:
    assert scan.labels is not None
    known = np.flatnonzero(np.asarray(scan.labels) >= 0)
    votes = np.zeros((mesh.vertex_count, 2))
    distance, nearest = cKDTree(scan.mesh.vertices[known]).query(mesh.vertices, distance_upper_bound=_REACH)
    near = np.flatnonzero(np.isfinite(distance))
    index = known[nearest[near]]
    facing = np.einsum("nx,nx->n", mesh.vertex_normals[near], scan.mesh.vertex_normals[index]) > _FACING
    near, index = near[facing], index[facing]
    votes[near, np.where(np.asarray(scan.labels)[index] == SKIN.id, 0, 1)] += 2.0
    return votes


def _votes_of_map(mesh: TriangleMesh, camera: Camera, labels: np.ndarray) -> Float64[np.ndarray, "V 2"]:
    """What a label map shows at the vertices that the naked body would show."""
    votes = np.zeros((mesh.vertex_count, 2))
    maps = rasterize_mesh(mesh, camera)
    screen = camera.screen_from_world(mesh.vertices)
    with np.errstate(invalid="ignore"):
        column, row = np.floor(screen[:, 0]), np.floor(screen[:, 1])
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (screen[:, 2] > 0)
    rays = mesh.vertices - camera.position
    towards = -np.einsum("nx,nx->n", rays, mesh.vertex_normals) / np.linalg.norm(rays, axis=1) > _FACING
    index = np.flatnonzero(inside & towards)
    r, c = row[index].astype(int), column[index].astype(int)
    visible = screen[index, 2] < maps.depth[r, c] + 0.01
    index, shown = index[visible], labels[r[visible], c[visible]]
    of_person = shown != _BACKGROUND
    votes[index[of_person], np.where(shown[of_person] == SKIN.id, 0, 1)] += 1.0
    return votes


def _eroded(body: BodyModel, bare: np.ndarray) -> np.ndarray:
    """Without vertices that share a face with one that is not bare."""
    touched = ~bare[body.faces].all(axis=1)
    out = bare.copy()
    out[body.faces[touched].ravel()] = False
    return out
