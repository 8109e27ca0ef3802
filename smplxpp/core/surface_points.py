"""Sample oriented points on a surface, and match surfaces by position and normal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh

TRUNCATION_M = 0.25
"""Distance, metres, at which `truncated_distance` saturates: more only says that the surfaces are apart."""


def draw_on_surface(
    mesh: TriangleMesh,
    count: int,
    *,
    seed: int | tuple[int, ...] = 0,
    method: Literal["stratified", "independent", "unsorted"] = "stratified",
) -> tuple[Int64[np.ndarray, " N"], Float64[np.ndarray, "N 3"]]:
    """Draw random points on a mesh with equal density per area.

    The generator is PCG64, so that one seed gives the same bits on all machines. The methods have different streams of
    random numbers:

    - "stratified": point i lies in stratum i of `count` equal shares of the area, in the order of the faces. It has
      less variance than independent points. Barycentric coordinates are `(1 - sqrt(a), sqrt(a) (1 - b), sqrt(a) b)`
      with a
      and b uniform (Osada et al. 2002).
    - "independent": independent points, sorted by face, with coordinates from the unit square folded at its diagonal.
    - "unsorted": independent points in random order, with coordinates from a Dirichlet distribution.

    Args:
        mesh: a mesh with area.
        count: number of points.
        seed: seed of the generator.
        method: one of the above.

    Returns:
        The face of each point, and its barycentric coordinates there.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    if method == "stratified":
        cumulative = np.cumsum(mesh.face_areas)
        share = (np.arange(count) + rng.random(count)) / count
        face = np.searchsorted(cumulative, share * cumulative[-1], side="right")
        # A share that rounds up to the whole area would fall behind the last face that has any.
        face = np.minimum(face, np.flatnonzero(mesh.face_areas)[-1])
        a, b = np.sqrt(rng.random(count)), rng.random(count)
        return face, np.stack([1 - a, a * (1 - b), a * b], axis=1)
    face = rng.choice(mesh.face_count, count, p=mesh.face_areas / mesh.face_areas.sum())
    if method == "unsorted":
        return face, rng.dirichlet((1.0, 1.0, 1.0), count)
    u, v = rng.random((2, count))
    # Pairs of the unit square above its diagonal are reflected into the triangle.
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
    return np.sort(face), np.stack([1 - u - v, u, v], axis=1)


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
        face, barycentric = draw_on_surface(mesh, count, seed=seed, method="independent")
        w, u, v = barycentric.T
        a, b, c = mesh.triangles[face].transpose(1, 0, 2)
        # Barycentric coordinates are (1 - u - v, u, v).
        points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        normals = mesh.vertex_normals[mesh.faces[face]]
        smooth = normals[:, 0] * w[:, None] + normals[:, 1] * u[:, None] + normals[:, 2] * v[:, None]
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
    # Points and normals as one feature vector, so that a nearest neighbour respects both.
    there, here = position_normal_features(points, normals), surface.tree.data
    # Searches of tree by tree pass the product of matrices that is all distances only from a million pairs on.
    if len(there) * len(here) <= 1_000_000:
        one, other = _nearest_of_all(there, here)
    else:
        # Beyond the bound the query returns infinity, which the truncation replaces.
        one, _ = surface.tree.query(there, distance_upper_bound=far)
        other, _ = cKDTree(there).query(here, distance_upper_bound=far)
    return float(0.5 * (np.minimum(one, far).mean() + np.minimum(other, far).mean()))


def _nearest_of_all(
    one: Float64[np.ndarray, "N K"], other: Float64[np.ndarray, "M K"]
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " M"]]:
    """Return the distance of each point to the nearest of the others, both ways.

    All squared distances `|a|^2 - 2 a.b + |b|^2` are one product of matrices. Points are taken from the middle of the
    others, because a difference of large squares loses digits.
    """
    middle = other.mean(axis=0)
    one, other = one - middle, other - middle
    left = np.column_stack([-2.0 * one, np.einsum("nk,nk->n", one, one), np.ones(len(one))])
    right = np.column_stack([other, np.ones(len(other)), np.einsum("mk,mk->m", other, other)])
    squared = left @ right.T
    nearest, nearest_other = (np.sqrt(np.maximum(squared.min(axis=axis), 0.0)) for axis in (1, 0))
    return nearest, nearest_other
