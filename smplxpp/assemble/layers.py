"""Measure where an outer layer of a clothed person penetrates an inner one, by the inner layer's signed distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body.model import BodyModel
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField

TOUCHING = 1e-6
"""Depth, metres, up to which a point only touches. Two parts of one scan touch at their seam to within rounding."""


class Obstacle:
    """An inner layer that outer layers must not penetrate.

    Args:
        name: name of the part.
        mesh: its surface, oriented outward.
        solid: whether it is a body, with an inside; otherwise it is a garment, an open surface with a back.
        max_depth: distance behind a garment, metres, up to which a point has penetrated it; farther away it belongs to
            another place (the other leg, the far side of the torso).
    """

    def __init__(self, name: str, mesh: TriangleMesh, *, solid: bool, max_depth: float) -> None:
        self.name = name
        self.solid, self._max_depth = solid, max_depth
        self._field = SignedDistanceField(mesh, solid=solid)
        used = mesh.vertices[np.unique(mesh.faces)]
        self._low, self._high = used.min(axis=0), used.max(axis=0)

    def distance(
        self, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]
    ) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, "N 3"]]:
        """Return the signed distance (N,) of points with outward unit normals, and its (N, 3) gradient.

        The distance is infinite farther than `max_depth` from the bounding box, and where a garment's sign means
        nothing: beside its border, farther behind it than `max_depth`, and where the surfaces are not parallel. Cloth
        penetrates parallel cloth; where a part crosses the other (a scan bridges the gap under a hem), points behind it
        are beside it. Surfaces are parallel if the cosine of their normals is above 0.5.
        """
        near = self._box_distance(points) <= self._max_depth
        found = self._field.query(points[near])
        distance, gradient = np.full(len(points), np.inf), np.zeros_like(points)
        if not self.solid:
            facing = np.einsum("ij,ij->i", found.normal, normals[near]) > 0.5
            meaningful = facing & ~found.on_border & (found.distance > -self._max_depth)
            found.distance[~meaningful] = np.inf
        distance[near], gradient[near] = found.distance, found.gradient
        return distance, gradient

    def lower_bound(self, points: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Return a lower bound of each point's distance, metres; infinite far behind a garment.

        A point with a positive bound can move so far without penetrating. Unlike `distance` it is finite beside borders
        and outside of the box, from where a small move may lead in front of a garment or behind it. The sign means
        nothing there, so that the bound is the distance less the depth up to which a point has penetrated.
        """
        bound = self._box_distance(points)
        near = bound <= self._max_depth
        found = self._field.query(points[near])
        if self.solid:
            bound[near] = found.distance
            return bound
        bound -= self._max_depth
        bound[near] = np.where(found.on_border, np.abs(found.distance) - self._max_depth, found.distance)
        return np.where(bound > -2.0 * self._max_depth, bound, np.inf)

    def _box_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance to the bounding box, metres, 0 inside, because far points need no search."""
        squared = np.zeros(len(points))
        for axis in range(3):
            x = points[:, axis]
            squared += np.maximum(np.maximum(self._low[axis] - x, x - self._high[axis]), 0.0) ** 2
        return np.sqrt(squared)

    def clearance(
        self, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"], wanted: float
    ) -> Float64[np.ndarray, " N"]:
        """Return the clearance that each point must keep, metres.

        It is `wanted`, but outside of a garment at most the distance that the point has already. Parts cut from one
        scan share a seam; a gap there would tear the cloth.
        """
        if self.solid:
            return np.full(len(points), wanted)
        start = self.distance(points, normals)[0]
        outside = np.clip(np.where(np.isfinite(start), start, 0.0), 0.0, wanted)
        return np.where(start < -TOUCHING, wanted, outside)


@dataclass(frozen=True)
class Penetration:
    """Points of an outer layer inside an inner one.

    Attributes:
        inner: name of the inner layer.
        vertices: number of vertices deeper inside than `TOUCHING`.
        face_points: number of points on faces (`face_points`) deeper inside.
        depth_mean: mean depth of those vertices, metres; 0 if none.
        depth_max: largest depth, metres; 0 if none.
    """

    inner: str
    vertices: int
    face_points: int
    depth_mean: float
    depth_max: float


def measure_penetration(mesh: TriangleMesh, obstacle: Obstacle) -> Penetration:
    """Count an outer layer's vertices and points on faces inside an inner layer, and measure the vertices' depth."""
    # Points on faces are tested too, because a face may cut through a corner that its vertices avoid.
    distance, _ = obstacle.distance(mesh.vertices, mesh.vertex_normals)
    points = face_points(mesh)
    between, _ = obstacle.distance(points.of(mesh, mesh.vertices), mesh.face_normals[points.face])
    depth = -distance[distance < -TOUCHING]
    return Penetration(
        inner=obstacle.name,
        vertices=len(depth),
        face_points=int((between < -TOUCHING).sum()),
        depth_mean=float(depth.mean()) if len(depth) else 0.0,
        depth_max=float(depth.max(initial=0.0)),
    )


@dataclass(frozen=True, eq=False)
class FacePoints:
    """Points on faces: `sum_k w_k v_k` over a face's corners.

    Attributes:
        face: (S,) face of each point.
        weights: (S, 3) its barycentric coordinates.
    """

    face: Int64[np.ndarray, " S"]
    weights: Float64[np.ndarray, "S 3"]

    def of(self, mesh: TriangleMesh, values: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "S 3"]:
        """Return values at the vertices interpolated at the points."""
        a, b, c = mesh.faces[self.face].T
        u, v, w = self.weights.T[:, :, None]
        return u * values[a] + v * values[b] + w * values[c]


def face_points(mesh: TriangleMesh, *, spacing: float = 0.016) -> FacePoints:
    """Return points that lie on the faces as densely as the vertices of a fine mesh.

    A face with edges up to `spacing` has its centre; a longer one, as simplification leaves where a surface is smooth,
    the centres of the n^2 triangles into which thirds, quarters, ... of its edges divide it.

    Args:
        mesh: N vertices, metres.
        spacing: longest edge of such a triangle, metres. The arc over a chord of 16 mm about a limb of 4 cm radius is
            0.8 mm high, less than the clearance of layers: what keeps it at both ends does not cut the limb.
    """
    # At most 16 parts of an edge: longer ones cross a hole that was filled, and no limb.
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    parts = np.clip(np.ceil(longest / spacing), 1, 16).astype(np.int64)
    faces, weights = [], []
    for n in np.unique(parts):
        own, centers = np.flatnonzero(parts == n), _subdivided(int(n))
        faces.append(np.repeat(own, len(centers)))
        weights.append(np.tile(centers, (len(own), 1)))
    return FacePoints(np.concatenate(faces), np.concatenate(weights))


def _subdivided(n: int) -> Float64[np.ndarray, "S 3"]:
    """Return the centres of the n^2 triangles into which n-ths of its edges divide a triangle, barycentric."""
    i, j = (index.ravel() for index in np.indices((n, n)))
    upright, turned = i + j < n, i + j < n - 1
    u = np.concatenate([i[upright] + 1 / 3, i[turned] + 2 / 3]) / n
    v = np.concatenate([j[upright] + 1 / 3, j[turned] + 2 / 3]) / n
    return np.stack([u, v, 1.0 - u - v], axis=1)


@dataclass(frozen=True)
class RemainingPenetration:
    """Vertices of a part that stay inside an inner layer after the repair, because the body does not fit the scan
    there.

    Attributes:
        vertices: number of vertices.
        depth: depth of the deepest, metres; 0 for none.
        where: number of vertices by the joint with the largest weight in the nearest skin, largest first.
    """

    vertices: int
    depth: float
    where: dict[str, int]

    @property
    def summary(self) -> str:
        """Return number, depth and the first three joints as text."""
        places = ", ".join(joint.replace("_", " ") for joint in list(self.where)[:3])
        more = " and others" if len(self.where) > 3 else ""
        return f"{self.vertices} vertices, up to {1e3 * self.depth:.1f} mm deep, near {places}{more}"


def remaining_penetration(
    mesh: TriangleMesh, obstacles: list[Obstacle], body: BodyModel, body_mesh: TriangleMesh
) -> RemainingPenetration:
    """Find the vertices of a repaired part that lie inside any inner layer.

    Args:
        mesh: the part.
        obstacles: its inner layers.
        body: the body model, which names the places.
        body_mesh: its surface in the part's pose.
    """
    # The largest depth of each vertex over all inner layers.
    depth = np.zeros(mesh.vertex_count)
    for obstacle in obstacles:
        depth = np.maximum(depth, -obstacle.distance(mesh.vertices, mesh.vertex_normals)[0])
    inside = np.flatnonzero(depth > TOUCHING)
    if not len(inside):
        return RemainingPenetration(0, 0.0, {})
    return RemainingPenetration(len(inside), float(depth.max()), joints_near(mesh.vertices[inside], body, body_mesh))


def joints_near(points: Float[np.ndarray, "N 3"], body: BodyModel, body_mesh: TriangleMesh) -> dict[str, int]:
    """Count points by the joint with the largest weight at the nearest skin vertex; the largest count comes first."""
    nearest = cKDTree(body_mesh.vertices).query(points)[1]
    counts = np.bincount(body.weights[nearest].argmax(axis=1), minlength=body.joint_count)
    order = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
    return {body.joint_names[k]: int(counts[k]) for k in order}
