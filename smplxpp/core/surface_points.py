"""A bare surface as points with normals, and pairs of points of two surfaces that face the same way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh

TURN_M = 0.15
"""Metres that a turn of the normal by 1 (57 degrees) counts as in the search for the nearest point."""
FAR = 0.25
"""A distance that says no more than "far": metres."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points spread evenly over a surface.

    Attributes:
        points: metres. normals: unit, outward. face: of the mesh that each was drawn from.
        tree: of points and scaled normals.
    """

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]
    face: Int64[np.ndarray, " N"]
    tree: cKDTree

    @staticmethod
    def of(mesh: TriangleMesh, count: int, *, seed: int = 0) -> SurfacePoints:
        """`count` points, drawn by area."""
        rng = np.random.default_rng(seed)
        share = mesh.face_areas / mesh.face_areas.sum()
        face = np.sort(rng.choice(mesh.face_count, count, p=share))
        u, v = rng.random((2, count))
        over = u + v > 1.0
        u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
        a, b, c = mesh.triangles[face].transpose(1, 0, 2)
        points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        normals = mesh.vertex_normals[mesh.faces[face]]
        smooth = normals[:, 0] * (1 - u - v)[:, None] + normals[:, 1] * u[:, None] + normals[:, 2] * v[:, None]
        length = np.linalg.norm(smooth, axis=1, keepdims=True)
        smooth = np.where(length > 0.1, smooth / np.maximum(length, 0.1), mesh.face_normals[face])
        return SurfacePoints.made(points, smooth, face)

    @staticmethod
    def made(points: np.ndarray, normals: np.ndarray, face: np.ndarray | None = None) -> SurfacePoints:
        """Of points and normals that are there."""
        face = np.full(len(points), -1, dtype=np.int64) if face is None else face.astype(np.int64)
        return SurfacePoints(points, normals, face, cKDTree(joined(points, normals)))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: np.ndarray) -> SurfacePoints:
        """Some of the points."""
        return SurfacePoints.made(self.points[rows], self.normals[rows], self.face[rows])


def joined(points: Float64[np.ndarray, "N 3"], normals: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 6"]:
    """Points and normals as one space: near is what is near and faces the same way."""
    return np.concatenate([points, TURN_M * normals], axis=1)


def truncated_distance(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    surface: SurfacePoints,
    *,
    far: float = FAR,
) -> float:
    """Mean of the distances of points to a surface and of the surface to them, each at most `far`, metres."""
    there = joined(points, normals)
    one, _ = surface.tree.query(there, distance_upper_bound=far)
    other, _ = cKDTree(there).query(surface.tree.data, distance_upper_bound=far)
    return float(0.5 * (np.minimum(one, far).mean() + np.minimum(other, far).mean()))
