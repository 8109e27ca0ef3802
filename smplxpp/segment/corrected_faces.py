"""Which faces of a scan lie under a brush, and where faces of another triangulation of it are."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import igl
import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh, normalize_rows
from smplxpp.core.topology import face_adjacency

# A stroke's line is looked at in so many samples a radius, at least a millimetre apart.
_SAMPLES, _LEAST_SPACING = 8, 1e-3
# A face under a brush faces as the surface under the line does, to this cosine: not the back of a sleeve or a finger.
_FACING = 0.1
# Metres above the line from which the nearest face is the one under it, where another sheet lies close below.
_LIFT = 0.001
# Steps from centre to centre over faces are longer than the way along the surface.
_DETOUR = 1.3
# Faces found again: how far off along the normal (metres), along the surface, a share of the first, and facing alike.
_OFF, _ASIDE, _ASIDE_SHARE, _ALIKE = 0.015, 1e-3, 0.5, 0.3


class ScanSurface:
    """A scan, and what is computed of it once for many corrections.

    Args:
        mesh: the scan.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh, self.centers = mesh, mesh.face_centers
        self._digest: str | None = None

    @cached_property
    def tree(self) -> igl.AABB:
        """The search tree of the faces."""
        tree = igl.AABB()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    def nearest(self, points: Float[np.ndarray, "n 3"]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """The nearest face to each point, and its distance, metres."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        squared, face, _ = self.tree.squared_distance(self.mesh.vertices, self.mesh.faces, points)
        return np.asarray(face, dtype=np.int64).reshape(-1), np.sqrt(np.asarray(squared).reshape(-1))

    @cached_property
    def pairs(self) -> Int64[np.ndarray, "P 2"]:
        """Faces that share an edge."""
        return face_adjacency(self.mesh.faces)[0].astype(np.int64)

    @cached_property
    def steps(self) -> csr_matrix:
        """Distances (M, M) between the centres of faces that share an edge, metres."""
        pairs = self.pairs
        length = np.linalg.norm(self.centers[pairs[:, 0]] - self.centers[pairs[:, 1]], axis=1)
        # A distance of 0 would be no edge.
        return csr_matrix((np.maximum(length, 1e-9), pairs.T), shape=(self.mesh.face_count,) * 2)

    def digest(self, of: Callable[[TriangleMesh], str]) -> str:
        """What `of` says of the mesh, computed once."""
        if self._digest is None:
            self._digest = of(self.mesh)
        return self._digest


def stroked_faces(
    surface: ScanSurface,
    points: Float[np.ndarray, "n 3"],
    radius: float,
    *,
    normals: Float[np.ndarray, "n 3"] | None = None,
) -> Int64[np.ndarray, " m"]:
    """Faces whose centres are within `radius` of a line on the surface, in space and, on faces that look the same way
    as the surface under it, along the surface: not the other leg, not the back of the hand.

    Args:
        points: the line's, metres. normals: of the surface under them; None: of the face nearest to each.
    """
    line, of_point = _sampled(np.asarray(points, dtype=np.float64), max(radius / _SAMPLES, _LEAST_SPACING))
    lift, above = min(0.5 * radius, _LIFT), line
    if normals is not None:
        upwards = normalize_rows(np.asarray(normals, dtype=np.float64))[of_point]
        above = line + lift * upwards
    seeds, away = surface.nearest(above)
    under = surface.mesh.face_normals[seeds]
    there = away <= radius + lift
    if normals is not None:
        there &= np.einsum("nx,nx->n", under, upwards) > 0
    line, seeds, under = line[there], seeds[there], under[there]
    if not len(line):
        return seeds
    around = (surface.centers >= line.min(axis=0) - radius) & (surface.centers <= line.max(axis=0) + radius)
    near = np.flatnonzero(around.all(axis=1))
    distance, nearest = cKDTree(line).query(surface.centers[near], distance_upper_bound=radius)
    near, nearest = near[np.isfinite(distance)], nearest[np.isfinite(distance)]
    facing = np.einsum("nx,nx->n", surface.mesh.face_normals[near], under[nearest])
    kept = np.union1d(near[facing > _FACING], seeds)
    inner, start = surface.steps[kept][:, kept], np.unique(np.searchsorted(kept, seeds))
    along = dijkstra(inner, directed=False, indices=start, limit=_DETOUR * radius, min_only=True)
    return kept[np.isfinite(along)]


def nearest_faces(surface: ScanSurface, triangles: Float[np.ndarray, "n 3 3"]) -> tuple[Int64[np.ndarray, " m"], float]:
    """Faces of a scan that lie where triangles of another triangulation of the same surface did.

    A face is found where its centre lies on one of the triangles, up to 15 mm off along their normal, and faces as it
    does. Where no centre does, as of a few small triangles on a coarse scan, the nearest faces stand for them.

    Returns:
        The faces, and their area as a share of the triangles'.
    """
    triangles = np.asarray(triangles, dtype=np.float64)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    triangles, cross = triangles[area > 0], cross[area > 0]
    if not len(triangles):
        return np.zeros(0, dtype=np.int64), 0.0
    normal = normalize_rows(cross)
    corners = triangles.reshape(-1, 3)
    inside = (surface.centers >= corners.min(axis=0) - _OFF) & (surface.centers <= corners.max(axis=0) + _OFF)
    near = np.flatnonzero(inside.all(axis=1))
    found = np.zeros(0, dtype=np.int64)
    if len(near):
        soup = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
        _, owner, closest = igl.point_mesh_squared_distance(surface.centers[near], corners, soup)[:3]
        own = normal[np.asarray(owner).reshape(-1)]
        offset = surface.centers[near] - closest
        off = np.einsum("nx,nx->n", offset, own)
        aside = np.linalg.norm(offset - off[:, None] * own, axis=1)
        alike = np.einsum("nx,nx->n", surface.mesh.face_normals[near], own) > _ALIKE
        found = near[alike & (np.abs(off) <= _OFF) & (aside <= _ASIDE + _ASIDE_SHARE * np.abs(off))]
    if not len(found):
        nearest, distance = surface.nearest(triangles.mean(axis=1))
        found = np.unique(nearest[distance <= _OFF])
    return found, float(surface.mesh.face_areas[found].sum() / area.sum())


def _sampled(
    points: Float64[np.ndarray, "n 3"], spacing: float
) -> tuple[Float64[np.ndarray, "m 3"], Int64[np.ndarray, " m"]]:
    """Points on a line, no farther apart than `spacing`, and the nearer of the line's own points for each."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(steps / spacing)).astype(np.int64)
    start = np.repeat(np.arange(len(steps)), counts)
    share = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[start]
    between = points[start] + share[:, None] * (points[start + 1] - points[start])
    owner = start + (share > 0.5)
    return np.concatenate([between, points[-1:]]), np.append(owner, len(points) - 1)
