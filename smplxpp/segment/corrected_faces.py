"""Select the faces of a scan under a brush stroke, and map faces of another triangulation onto it."""

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


class ScanSurface:
    """A scan with its search structures, which are built once for many corrections.

    Args:
        mesh: the scan.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh, self.centers = mesh, mesh.face_centers
        self._digest: str | None = None

    @cached_property
    def tree(self) -> igl.AABB:
        """Return the bounding volume hierarchy of the faces."""
        tree = igl.AABB()
        tree.init(self.mesh.vertices, self.mesh.faces)
        return tree

    def nearest(self, points: Float[np.ndarray, "n 3"]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return the nearest face to each point, and its distance in metres."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        squared, face, _ = self.tree.squared_distance(self.mesh.vertices, self.mesh.faces, points)
        return np.asarray(face, dtype=np.int64).reshape(-1), np.sqrt(np.asarray(squared).reshape(-1))

    @cached_property
    def pairs(self) -> Int64[np.ndarray, "P 2"]:
        """Return the pairs of faces that share an edge."""
        return face_adjacency(self.mesh.faces)[0].astype(np.int64)

    @cached_property
    def steps(self) -> csr_matrix:
        """Return the distances (M, M), in metres, between the centres of faces that share an edge."""
        pairs = self.pairs
        length = np.linalg.norm(self.centers[pairs[:, 0]] - self.centers[pairs[:, 1]], axis=1)
        # The sparse graph would drop an edge of length 0.
        return csr_matrix((np.maximum(length, 1e-9), pairs.T), shape=(self.mesh.face_count,) * 2)

    def digest(self, of: Callable[[TriangleMesh], str]) -> str:
        """Return the digest of the mesh by the function `of`, computed once."""
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
    """Return the faces within a geodesic distance of a polyline on the surface.

    A face belongs to the stroke if its centre lies within `radius` of the polyline in space, if its normal agrees with
    the surface below the polyline, and if a path over such faces reaches it. So neither the other leg nor the back of
    the hand is painted.

    Args:
        surface: the scan.
        points: vertices of the polyline, metres.
        radius: of the brush, metres.
        normals: normals of the surface below the points; None takes those of the nearest faces.
    """
    # Sample the polyline at eighths of the radius, at least a millimetre apart.
    line, of_point = _sampled(np.asarray(points, dtype=np.float64), max(radius / 8, 1e-3))
    # Look up the face below each sample from up to 1 mm above the surface, so that a second sheet close below does not
    # win, and drop samples whose face is too far away or has an opposite normal.
    lift, above = min(0.5 * radius, 0.001), line
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
    # Candidates: faces within the radius in space whose normals agree with the surface below the polyline. The cosine
    # of 0.1 excludes the back of a sleeve or a finger.
    around = (surface.centers >= line.min(axis=0) - radius) & (surface.centers <= line.max(axis=0) + radius)
    near = np.flatnonzero(around.all(axis=1))
    distance, nearest = cKDTree(line).query(surface.centers[near], distance_upper_bound=radius)
    near, nearest = near[np.isfinite(distance)], nearest[np.isfinite(distance)]
    facing = np.einsum("nx,nx->n", surface.mesh.face_normals[near], under[nearest])
    kept = np.union1d(near[facing > 0.1], seeds)
    # Geodesic distance by Dijkstra over face centres. Such paths are up to 30 % longer than the geodesic.
    inner, start = surface.steps[kept][:, kept], np.unique(np.searchsorted(kept, seeds))
    along = dijkstra(inner, directed=False, indices=start, limit=1.3 * radius, min_only=True)
    return kept[np.isfinite(along)]


def nearest_faces(surface: ScanSurface, triangles: Float[np.ndarray, "n 3 3"]) -> tuple[Int64[np.ndarray, " m"], float]:
    """Return the faces of a scan that coincide with triangles of another triangulation of the same surface.

    A face coincides if its centre projects onto one of the triangles, at most 15 mm along its normal, and the normals
    agree. If no centre does, as with a few small triangles on a coarse scan, the nearest faces are taken.

    Returns:
        The faces, and their area as a share of the triangles' area.
    """
    # Largest distance along the normal, metres: more than noise, less than the distance between limbs.
    reach = 0.015
    triangles = np.asarray(triangles, dtype=np.float64)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    triangles, cross = triangles[area > 0], cross[area > 0]
    if not len(triangles):
        return np.zeros(0, dtype=np.int64), 0.0
    normal = normalize_rows(cross)
    # Only faces within the triangles' bounding box are compared.
    corners = triangles.reshape(-1, 3)
    inside = (surface.centers >= corners.min(axis=0) - reach) & (surface.centers <= corners.max(axis=0) + reach)
    near = np.flatnonzero(inside.all(axis=1))
    found = np.zeros(0, dtype=np.int64)
    if len(near):
        # Split the offset to the closest point into a part along the normal and a tangential part. The tangential part
        # is 0 within a triangle; at its edges it may be 1 mm and half of the normal part, because normals differ there.
        soup = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
        _, owner, closest = igl.point_mesh_squared_distance(surface.centers[near], corners, soup)[:3]
        own = normal[np.asarray(owner).reshape(-1)]
        offset = surface.centers[near] - closest
        along = np.einsum("nx,nx->n", offset, own)
        tangential = np.linalg.norm(offset - along[:, None] * own, axis=1)
        alike = np.einsum("nx,nx->n", surface.mesh.face_normals[near], own) > 0.3
        found = near[alike & (np.abs(along) <= reach) & (tangential <= 1e-3 + 0.5 * np.abs(along))]
    if not len(found):
        nearest, distance = surface.nearest(triangles.mean(axis=1))
        found = np.unique(nearest[distance <= reach])
    return found, float(surface.mesh.face_areas[found].sum() / area.sum())


def _sampled(
    points: Float64[np.ndarray, "n 3"], spacing: float
) -> tuple[Float64[np.ndarray, "m 3"], Int64[np.ndarray, " m"]]:
    """Return samples of a polyline at most `spacing` apart, and the nearer of its own vertices for each sample."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(steps / spacing)).astype(np.int64)
    start = np.repeat(np.arange(len(steps)), counts)
    share = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[start]
    between = points[start] + share[:, None] * (points[start + 1] - points[start])
    owner = start + (share > 0.5)
    return np.concatenate([between, points[-1:]]), np.append(owner, len(points) - 1)
