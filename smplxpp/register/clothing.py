"""Estimate what covers the body: which vertices are bare skin, and how far cloth stands off elsewhere.

Bare vertices are voted for by labelled scans and label maps. Cloth constrains a body only as far as it keeps its
distance: at every place of the body, the distances observed over views and frames have a median, the gap, and a spread.
A tight shirt holds the body to millimetres, the hem of a skirt does not hold it at all. So surfaces of cloth are never
pulled onto the body, and loose ones do not pull.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import SKIN, BodyParams, Camera, TriangleMesh, spread
from smplxpp.raster import rasterize_mesh
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics
from smplxpp.register.landmarks import is_finger
from smplxpp.register.observations import Observations, ScanObservation

# Cosine between the normals of body and scan, or normal and ray, from which an observation votes.
_FACING = 0.3


@dataclass(frozen=True, eq=False)
class Gaps:
    """Distances between the body and what it wears, at K places.

    Attributes:
        median: metres, never negative.
        spread: robust standard deviation, metres; inf where too little was observed.
    """

    median: Float64[np.ndarray, " K"]
    spread: Float64[np.ndarray, " K"]

    @staticmethod
    def unknown(count: int) -> Gaps:
        """Return gaps of which nothing is known yet."""
        return Gaps(np.zeros(count), np.full(count, np.inf))

    @staticmethod
    def estimated(
        place: Int64[np.ndarray, " N"], distance: Float64[np.ndarray, " N"], count: int, *, least: int, tight: float
    ) -> Gaps:
        """Estimate the median and spread of the distances observed at each place.

        Args:
            place: of each observation, 0 to K - 1.
            distance: of each observation, metres.
            count: number of places K.
            least: number of observations from which a place is known.
            tight: lower bound of the spread, metres.
        """
        # Sort by place, then by distance, so that every place is a slice whose quantiles are entries.
        order = np.lexsort((distance, place))
        place, distance = place[order], distance[order]
        start = np.searchsorted(place, np.arange(count))
        number = np.searchsorted(place, np.arange(count), side="right") - start
        known = number >= least
        median, spread = np.zeros(count), np.full(count, np.inf)
        # Half the distance from the 15.9 % to the 84.1 % quantile is the standard deviation of a Gaussian.
        low, high = start + (number * 0.159).astype(int), start + (number * 0.841).astype(int)
        middle = np.minimum(start + number // 2, len(distance) - 1)
        if known.any():
            median[known] = distance[middle[known]]
            last = len(distance) - 1
            wide = distance[np.minimum(high[known], last)] - distance[np.minimum(low[known], last)]
            spread[known] = np.hypot(0.5 * wide, tight)
        # Cloth is not inside the body.
        return Gaps(np.maximum(median, 0.0), spread)


def in_order_of_frames(
    distances: Sequence[tuple[int, np.ndarray, np.ndarray]],
) -> tuple[Int64[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """Join places and distances of frames, which threads add in any order, by the number of the frame."""
    _, places, values = zip(*sorted(distances, key=itemgetter(0)), strict=True)
    return np.concatenate(places), np.concatenate(values)


def bare_vertices(
    kinematics: Kinematics, state: BodyState, observed: Observations, frames: list[int], points: BodyPoints
) -> Bool[np.ndarray, " V"] | None:
    """Return the vertices that scans and label maps show as skin, with all their neighbours; None without any labels.

    Args:
        kinematics: of the body.
        state: an approximate fit, one row for each of `frames`.
        observed: scans and label maps.
        frames: their numbers.
        points: all vertices of the body.
    """
    most_mapped = 6  # frames whose label maps vote; more change little and cost a rasterisation a camera
    body = kinematics.body
    votes = np.zeros((body.vertex_count, 2))
    # Votes for skin and against it, first of every labelled scan ...
    for row, frame in enumerate(frames):
        scan = observed.scans.get(frame)
        if scan is not None and scan.labels is not None:
            mesh = body.mesh(kinematics.points(points, kinematics.posture(state, row)))
            votes += _votes_of_scan(mesh, scan)
    # ... then of the label maps of some frames, spread evenly.
    if observed.labels is not None:
        mapped = [row for row, frame in enumerate(frames) if _has_map(observed, frame)]
        for row in spread(mapped, most_mapped):
            mesh = body.mesh(kinematics.points(points, kinematics.posture(state, row)))
            for name, camera in observed.cameras.items():
                labels = observed.labels(name, frames[row])
                if labels is not None:
                    votes += _votes_of_map(mesh, camera, labels)
    return _bare(body, votes) if votes.any() else None


def _bare(body: BodyModel, votes: Float64[np.ndarray, "V 2"]) -> Bool[np.ndarray, " V"]:
    """Return the vertices with three quarters of their votes for skin, eroded by one ring of neighbours."""
    total = votes.sum(axis=1)
    return _eroded(body, (total >= 1.0) & (votes[:, 0] > 0.75 * np.maximum(total, 1e-9)))


def bare_of_scan(body: BodyModel, params: BodyParams, scan: ScanObservation) -> Bool[np.ndarray, " V"]:
    """Return the vertices that one labelled scan shows as skin, with all their neighbours.

    Args:
        body: the body model.
        params: one row, the body in the scan.
        scan: with labels.
    """
    votes = _votes_of_scan(body.mesh(body.forward(params).vertices[0]), scan)
    return _bare(body, votes)


def hand_vertices(body: BodyModel) -> Bool[np.ndarray, " V"]:
    """Return the vertices of the fingers, which are assumed to be bare where no labels say it."""
    fingers = np.array([is_finger(name) for name in body.joint_names])
    return body.weights[:, fingers].sum(axis=1) > 0.3


def _has_map(observed: Observations, frame: int) -> bool:
    assert observed.labels is not None
    return any(observed.labels(name, frame) is not None for name in list(observed.cameras)[:3])


def _votes_of_scan(mesh: TriangleMesh, scan: ScanObservation) -> Float64[np.ndarray, "V 2"]:
    """Return two votes a vertex for what the scan shows within 3 cm of it, facing alike."""
    assert scan.labels is not None
    # Points without a label do not vote.
    known = np.flatnonzero(np.asarray(scan.labels) >= 0)
    votes = np.zeros((mesh.vertex_count, 2))
    distance, nearest = cKDTree(scan.mesh.vertices[known]).query(mesh.vertices, distance_upper_bound=0.03)
    near = np.flatnonzero(np.isfinite(distance))
    index = known[nearest[near]]
    # A surface that faces elsewhere is another layer, or another limb that touches.
    facing = np.einsum("nx,nx->n", mesh.vertex_normals[near], scan.mesh.vertex_normals[index]) > _FACING
    near, index = near[facing], index[facing]
    votes[near, np.where(np.asarray(scan.labels)[index] == SKIN.id, 0, 1)] += 2.0
    return votes


def _votes_of_map(mesh: TriangleMesh, camera: Camera, labels: np.ndarray) -> Float64[np.ndarray, "V 2"]:
    """Return one vote a vertex for what a label map shows where the body without clothes would be visible."""
    votes = np.zeros((mesh.vertex_count, 2))
    # Render the body without clothes: where it is visible, the map shows either its skin or what covers it.
    maps = rasterize_mesh(mesh, camera)
    screen = camera.screen_from_world(mesh.vertices)
    with np.errstate(invalid="ignore"):
        column, row = np.floor(screen[:, 0]), np.floor(screen[:, 1])
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (screen[:, 2] > 0)
    rays = mesh.vertices - camera.position
    towards = -np.einsum("nx,nx->n", rays, mesh.vertex_normals) / np.linalg.norm(rays, axis=1) > _FACING
    index = np.flatnonzero(inside & towards)
    r, c = row[index].astype(int), column[index].astype(int)
    # z-buffer test with 1 cm tolerance; pixels of the background (255) do not vote.
    visible = screen[index, 2] < maps.depth[r, c] + 0.01
    index, shown = index[visible], labels[r[visible], c[visible]]
    of_person = shown != 255
    votes[index[of_person], np.where(shown[of_person] == SKIN.id, 0, 1)] += 1.0
    return votes


def _eroded(body: BodyModel, bare: np.ndarray) -> np.ndarray:
    """Remove the vertices that share a face with a vertex that is not bare."""
    touched = ~bare[body.faces].all(axis=1)
    out = bare.copy()
    out[body.faces[touched].ravel()] = False
    return out
