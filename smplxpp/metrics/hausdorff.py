"""Bound the Hausdorff distance of two surfaces from below and above, by branch and bound over triangles.

Samples bound it from below alone: the largest distance of a spike's tip is missed wherever no sample falls on the tip.
Of a triangle T with corners v_i, whose nearest faces of the other surface B are F_i, two bounds are known:

    max_{x in T} d(x, B) <= min_i (d(v_i, B) + max_k |v_i - v_k|)          d is Lipschitz with constant 1
    max_{x in T} d(x, B) <= min_i max_k d(v_k, F_i)                        d(x, F) is convex in x for a convex face F

(Guthe, Borodin, Klein, WSCG 2005; Tang, Lee, Kim, SIGGRAPH 2009). A triangle whose bound is not above the largest
distance found so far cannot hold the maximum; the others are cut into four until the bounds meet.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import igl
import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core import MeshLike, TriangleMesh, as_mesh, require_positive, row_lengths
from smplxpp.metrics.sampling import require_surface

_AT_ONCE = 1 << 16
"""Triangles cut in one round: the largest bounds first, so that small ones are often never cut."""
_ROUNDING = 1e-12
"""Share of the boxes' diagonal added to upper bounds: distances in float64 are wrong by less."""


@dataclass(frozen=True)
class DirectedHausdorff:
    """Bounds of the largest distance from a surface to another, mm.

    Attributes:
        lower_mm, upper_mm: the true value lies between them.
        point: where the lower bound is attained, in the mesh's own coordinates.
        evaluations: points whose distance was computed.
    """

    lower_mm: float
    upper_mm: float
    point: tuple[float, float, float]
    evaluations: int


@dataclass(frozen=True)
class HausdorffBounds:
    """Bounds of the Hausdorff distance of two surfaces, mm, and of both of its directions."""

    a_to_b: DirectedHausdorff
    b_to_a: DirectedHausdorff

    @property
    def lower_mm(self) -> float:
        """The distance is at least this."""
        return max(self.a_to_b.lower_mm, self.b_to_a.lower_mm)

    @property
    def upper_mm(self) -> float:
        """The distance is at most this."""
        return max(self.a_to_b.upper_mm, self.b_to_a.upper_mm)

    def as_dict(self) -> dict:
        """Return the bounds as plain numbers for JSON."""
        return {"lower_mm": self.lower_mm, "upper_mm": self.upper_mm, **asdict(self)}


def hausdorff(
    a: MeshLike, b: MeshLike, *, tolerance_mm: float = 0.01, most_evaluations: int = 5_000_000, unit: str = "m"
) -> HausdorffBounds:
    """Bound the Hausdorff distance of two surfaces, `max(max_a d(a, B), max_b d(b, A))`, over all points, not samples.

    Args:
        a: mesh with an area; faces without area add no surface.
        b: the other one, likewise.
        tolerance_mm: gap between the bounds at which the search stops; infinity gives the maximum over vertices as the
            lower bound, and an upper bound from edge lengths, in one pass.
        most_evaluations: points a direction after which it stops with the gap that is left. Meshes of which one is 50
            times as large as the other get 5,000: their units differ, and every face is about as near, so that a point
            takes a hundred times as long and the answer tells nothing.
        unit: of both meshes.

    Raises:
        InputError: a mesh without area, or a tolerance that is not positive.

    Example:
        >>> square = ([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
        >>> bounds = hausdorff(square, (np.add(square[0], [0, 0, 0.003]), square[1]))
        >>> round(bounds.lower_mm, 6), round(bounds.upper_mm, 6)
        (3.0, 3.0)
    """
    require_positive("tolerance in mm", tolerance_mm, finite=False)
    first, second = as_mesh(a, subject="first mesh", unit=unit), as_mesh(b, subject="second mesh", unit=unit)
    require_surface(first, "first mesh")
    require_surface(second, "second mesh")
    one, other = _Target(first), _Target(second)
    other_unit = 50.0  # ratio of sizes; a hand, the least part that is compared with a body, is a tenth of it
    sizes = one.mesh.bbox_diagonal, other.mesh.bbox_diagonal
    most = most_evaluations if max(sizes) <= other_unit * min(sizes) else min(most_evaluations, 5_000)
    gap = 1e-3 * tolerance_mm
    return HausdorffBounds(_directed(one, other, gap, most), _directed(other, one, gap, most))


class _Target:
    """The faces of a mesh that have an area, and the tree in which nearest ones are found."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh.submesh(mesh.face_areas > 0)[0]
        self._tree = igl.AABB()
        self._tree.init(self.mesh.vertices, self.mesh.faces)

    def query(self, points: Float64[np.ndarray, "P 3"]) -> tuple[Float64[np.ndarray, " P"], Int64[np.ndarray, " P"]]:
        """Return the distance to the nearest face, and the face."""
        squared, face, _ = self._tree.squared_distance(
            self.mesh.vertices, self.mesh.faces, np.ascontiguousarray(points)
        )
        return np.sqrt(squared), face.astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Triangles:
    """K triangles of the source that may hold the maximum.

    Attributes:
        corners: metres.
        distance: of the corners to the target.
        face: the target's faces nearest to the corners.
        bound: no point of the triangle is farther from the target.
    """

    corners: Float64[np.ndarray, "K 3 3"]
    distance: Float64[np.ndarray, "K 3"]
    face: Int64[np.ndarray, "K 3"]
    bound: Float64[np.ndarray, " K"]

    def select(self, rows: np.ndarray) -> _Triangles:
        return _Triangles(self.corners[rows], self.distance[rows], self.face[rows], self.bound[rows])


def _directed(source: _Target, target: _Target, gap: float, most: int) -> DirectedHausdorff:
    """Bound the largest distance from `source` to `target`, metres, until the bounds are within `gap`."""
    mesh = source.mesh
    search = _Search(target, gap)
    distance, face = search.measure(mesh.vertices)
    every = _Triangles(mesh.triangles, distance[mesh.faces], face[mesh.faces], np.full(mesh.face_count, np.inf))
    # What is dropped is at most `enough` of its time, which only grows; what is kept has its own bound.
    active = search.bounded(every)
    while np.isfinite(gap) and len(active.bound) and search.evaluations < most:
        # Cut the triangles with the largest bounds into four at the middles of their edges.
        count = min(_AT_ONCE, len(active.bound))
        order = np.argpartition(-active.bound, count - 1)
        rest, cut = active.select(order[count:]), active.select(order[:count])
        middles = 0.5 * (cut.corners + np.roll(cut.corners, -1, axis=1))
        found, near = (values.reshape(-1, 3) for values in search.measure(middles.reshape(-1, 3)))
        made = search.bounded(
            _Triangles(
                np.concatenate([cut.corners, middles], axis=1)[:, _CHILDREN].reshape(-1, 3, 3),
                np.concatenate([cut.distance, found], axis=1)[:, _CHILDREN].reshape(-1, 3),
                np.concatenate([cut.face, near], axis=1)[:, _CHILDREN].reshape(-1, 3),
                np.repeat(cut.bound, 4),
            )
        )
        rest = rest.select(rest.bound > search.enough)
        active = _Triangles(*(np.concatenate([getattr(rest, name), getattr(made, name)]) for name in vars(made)))
    largest = float(active.bound.max(initial=0.0))
    upper = max(largest, search.enough) if np.isfinite(gap) else largest
    slack = _ROUNDING * (mesh.bbox_diagonal + target.mesh.bbox_diagonal + search.lower)
    x, y, z = search.point.tolist()
    return DirectedHausdorff(
        1e3 * search.lower, 1e3 * (max(upper, search.lower) + slack), (x, y, z), search.evaluations
    )


# Corners 0, 1, 2 and middles 3 (of 0 and 1), 4 (of 1 and 2), 5 (of 2 and 0).
_CHILDREN = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])


class _Search:
    """The largest distance to a target that was found so far, and the bounds of triangles."""

    def __init__(self, target: _Target, gap: float) -> None:
        self._target, self._gap = target, gap
        self.lower, self.point, self.evaluations = 0.0, target.mesh.vertices[0], 0

    @property
    def enough(self) -> float:
        """A triangle with no larger bound than this decides nothing."""
        return self.lower + self._gap

    def measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances and nearest faces of points, and keep the largest distance."""
        distance, face = self._target.query(points)
        self.evaluations += len(points)
        if len(points) and distance.max() >= self.lower:
            self.lower, self.point = float(distance.max()), points[int(distance.argmax())]
        return distance, face

    def bounded(self, triangles: _Triangles) -> _Triangles:
        """Return those of the triangles that may hold the maximum, with the least of their known bounds."""
        # By the edges: no point of a triangle is farther from a corner than that corner's longer edge.
        corners = triangles.corners
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        reach = np.maximum(sides, np.roll(sides, 1, axis=1))
        bound = np.minimum(triangles.bound, (triangles.distance + reach).min(axis=1))
        if not np.isfinite(self._gap):
            return _Triangles(corners, triangles.distance, triangles.face, bound)
        kept = self._lowered(triangles, bound)
        # By convexity: the distances of all corners to the face that is nearest to one of them, then to the centre,
        # which lies within the face that a triangle of nearly the same surface is compared with.
        for i in range(3):
            kept = self._lowered(kept, self._farthest_corner(kept, kept.face[:, i]))
        if not len(kept.bound):
            return kept
        _, face = self.measure(kept.corners.mean(axis=1))
        return self._lowered(kept, self._farthest_corner(kept, face))

    def _lowered(self, triangles: _Triangles, bound: np.ndarray) -> _Triangles:
        bound = np.minimum(triangles.bound, bound)
        kept = bound > self.enough
        return _Triangles(triangles.corners, triangles.distance, triangles.face, bound).select(kept)

    def _farthest_corner(self, triangles: _Triangles, face: np.ndarray) -> np.ndarray:
        """Return the largest distance of a triangle's corners to a face of the target."""
        out = np.zeros(len(face))
        nearest = self._target.mesh.triangles[face]
        for k in range(3):
            # A corner's distance to its own nearest face is known.
            distance = triangles.distance[:, k].copy()
            todo = np.flatnonzero(triangles.face[:, k] != face)
            distance[todo] = _at_most(triangles.corners[todo, k], nearest[todo])
            out = np.maximum(out, distance)
        return out


def _at_most(points: Float64[np.ndarray, "K 3"], triangles: Float64[np.ndarray, "K 3 3"]) -> Float64[np.ndarray, " K"]:
    """Return the distance of each point to its triangle; rounding can make it larger but not smaller.

    It is the least distance to points that lie in the triangle by construction: the nearest of each side, and the
    projection with its barycentric coordinates clipped.
    """
    best = np.full(len(points), np.inf)
    for k in range(3):
        start, along = triangles[:, k], triangles[:, (k + 1) % 3] - triangles[:, k]
        length = np.maximum(np.einsum("ij,ij->i", along, along), np.finfo(float).tiny)
        share = np.clip(np.einsum("ij,ij->i", points - start, along) / length, 0.0, 1.0)
        best = np.minimum(best, row_lengths(points - start - share[:, None] * along))
    weights = np.clip(igl.barycentric_coordinates(points, *np.ascontiguousarray(triangles.transpose(1, 0, 2))), 0, None)
    weights = np.nan_to_num(weights)
    total = weights.sum(axis=1, keepdims=True)
    inside = np.einsum("ik,ikd->id", weights / np.where(total > 0, total, 1.0), triangles)
    return np.minimum(best, np.where(total[:, 0] > 0, row_lengths(points - inside), np.inf))
