"""Sample oriented points on a surface, and match surfaces by position and normal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh

TRUNCATION_M = 0.25
"""Distance, metres, at which `truncated_distance` saturates: more only says that the surfaces are apart."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points spread evenly over a surface.

    Attributes:
        points: metres.
        normals: unit length, outward.
        face: index of the mesh face that each point was drawn from, -1 where unknown.
        tree: search tree of `position_normal_features`.
    """

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]
    face: Int64[np.ndarray, " N"]
    tree: cKDTree

    @staticmethod
    def sample(mesh: TriangleMesh, count: int, *, seed: int = 0) -> SurfacePoints:
        """Draw `count` points with equal density per area, with interpolated vertex normals."""
        rng = np.random.default_rng(seed)
        share = mesh.face_areas / mesh.face_areas.sum()
        face = np.sort(rng.choice(mesh.face_count, count, p=share))
        u, v = rng.random((2, count))
        # Uniform barycentric coordinates: pairs of the unit square above its diagonal are reflected into the triangle.
        over = u + v > 1.0
        u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
        a, b, c = mesh.triangles[face].transpose(1, 0, 2)
        points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        normals = mesh.vertex_normals[mesh.faces[face]]
        smooth = normals[:, 0] * (1 - u - v)[:, None] + normals[:, 1] * u[:, None] + normals[:, 2] * v[:, None]
        # Where interpolated normals nearly cancel, take the face's normal.
        length = np.linalg.norm(smooth, axis=1, keepdims=True)
        smooth = np.where(length > 0.1, smooth / np.maximum(length, 0.1), mesh.face_normals[face])
        return SurfacePoints.from_arrays(points, smooth, face)

    @staticmethod
    def from_arrays(points: np.ndarray, normals: np.ndarray, face: np.ndarray | None = None) -> SurfacePoints:
        """Make surface points from given positions and normals."""
        face = np.full(len(points), -1, dtype=np.int64) if face is None else face.astype(np.int64)
        return SurfacePoints(points, normals, face, cKDTree(position_normal_features(points, normals)))

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: np.ndarray) -> SurfacePoints:
        """Return the points of the given rows, with a new search tree."""
        return SurfacePoints.from_arrays(self.points[rows], self.normals[rows], self.face[rows])


def position_normal_features(
    points: Float64[np.ndarray, "N 3"], normals: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 6"]:
    """Join positions and scaled normals to features: close ones lie close together and face the same direction.

    Normals that differ by 1 (57 degrees) count as 0.15 m of distance. More weight prefers points that face the same
    direction over nearer ones.
    """
    return np.concatenate([points, 0.15 * normals], axis=1)


def truncated_distance(
    points: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    surface: SurfacePoints,
    *,
    far: float = TRUNCATION_M,
) -> float:
    """Return the symmetric mean distance between points and a surface, each distance truncated at `far`, metres.

    Distances are those of `position_normal_features`, so that opposite normals add to them.
    """
    there = position_normal_features(points, normals)
    one, _ = surface.tree.query(there, distance_upper_bound=far)
    other, _ = cKDTree(there).query(surface.tree.data, distance_upper_bound=far)
    return float(0.5 * (np.minimum(one, far).mean() + np.minimum(other, far).mean()))
