"""Layers of a clothed person: who lies outside whom, and where an outer layer cuts into an inner one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField

# Metres; two parts of one scan touch at their seam to within rounding.
TOUCHING = 1e-6
# Cloth comes through cloth where both run alike. Where one part's web stands across the other (a scan bridges the gap
# under a hem) the points behind the web are beside it, not through it: normals' cosine above which layers run alike.
_PARALLEL = 0.5


class Obstacle:
    """An inner layer that outer ones must stay out of.

    Args:
        name: of the part.
        mesh: its surface, outward.
        solid: a body, with an inside; otherwise a garment, an open surface with a back.
        max_depth: metres behind a garment up to which a point counts as having come through it; further away it
            belongs somewhere else (the other leg, the far side of the torso).
    """

    def __init__(self, name: str, mesh: TriangleMesh, *, solid: bool, max_depth: float) -> None:
        self.name = name
        self._solid, self._max_depth = solid, max_depth
        self._field = SignedDistanceField(mesh, solid=solid)
        used = mesh.vertices[np.unique(mesh.faces)]
        self._low, self._high = used.min(axis=0), used.max(axis=0)

    def distance(
        self, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
    ) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, "N 3"]]:
        """Signed distance (N,) of (N, 3) points with (N, 3) outward unit normals, and its (N, 3) gradient.

        The answer is infinite further than `max_depth` from the bounding box, and where the question has none: beside
        a garment's border, further behind it than `max_depth`, and where the two surfaces do not run alike.
        """
        near = self._box_distance(points) <= self._max_depth
        found = self._field.query(points[near])
        distance, gradient = np.full(len(points), np.inf), np.zeros_like(points)
        if not self._solid:
            facing = np.einsum("ij,ij->i", found.normal, normals[near]) > _PARALLEL
            meaningful = facing & ~found.on_border & (found.distance > -self._max_depth)
            found.distance[~meaningful] = np.inf
        distance[near], gradient[near] = found.distance, found.gradient
        return distance, gradient

    def lower_bound(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """The way, in metres, that each point above zero can go without coming inside; infinite far behind a garment.

        Unlike `distance` it answers beside borders too, where a small move may give the question an answer.
        """
        bound = self._box_distance(points)
        near = bound <= self._max_depth
        bound[near] = self._field.query(points[near]).distance
        return bound if self._solid else np.where(bound > -2.0 * self._max_depth, bound, np.inf)

    def _box_distance(self, points: np.ndarray) -> np.ndarray:
        """Metres to the bounding box, 0 inside: far points need no search."""
        squared = np.zeros(len(points))
        for axis in range(3):
            x = points[:, axis]
            squared += np.maximum(np.maximum(self._low[axis] - x, x - self._high[axis]), 0.0) ** 2
        return np.sqrt(squared)

    def clearance(
        self, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"], wanted: float
    ) -> Float64[np.ndarray, " N"]:
        """The metres that each point must keep: `wanted`, but no more than it has from a garment it did not cut into.

        Parts cut from one scan share a seam; a gap there would have to tear the cloth.
        """
        if self._solid:
            return np.full(len(points), wanted)
        start = self.distance(points, normals)[0]
        outside = np.clip(np.where(np.isfinite(start), start, 0.0), 0.0, wanted)
        return np.where(start < -TOUCHING, wanted, outside)


@dataclass(frozen=True)
class Penetration:
    """Points of an outer layer inside an inner one.

    Attributes:
        inner: name of the inner layer.
        vertices: vertices inside by more than `TOUCHING`. face_centers: centres of faces inside by more.
        depth_mean, depth_max: of those vertices, metres; 0 if none.
    """

    inner: str
    vertices: int
    face_centers: int
    depth_mean: float
    depth_max: float


def measure_penetration(mesh: TriangleMesh, obstacle: Obstacle) -> Penetration:
    """Count and depth of an outer layer's vertices and face centres inside an inner layer."""
    distance, _ = obstacle.distance(mesh.vertices, mesh.vertex_normals)
    centers, _ = obstacle.distance(face_centers(mesh, mesh.vertices), mesh.face_normals)
    depth = -distance[distance < -TOUCHING]
    return Penetration(
        inner=obstacle.name,
        vertices=len(depth),
        face_centers=int((centers < -TOUCHING).sum()),
        depth_mean=float(depth.mean()) if len(depth) else 0.0,
        depth_max=float(depth.max(initial=0.0)),
    )


def face_centers(mesh: TriangleMesh, values: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "M 3"]:
    """The mean over each face's corners of values at the vertices."""
    a, b, c = mesh.faces.T
    return (values[a] + values[b] + values[c]) / 3.0
