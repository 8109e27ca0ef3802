"""Cut the polygons of mesh files into triangles: fans where a corner sees the whole polygon, else ears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Integer

from smplxpp.core.mesh_files.raw_mesh import warn

_SHARE = 1e-9  # of a polygon's area: triangles may be turned over by so little, which is rounding
_STARTS = 64  # polygons of more corners are not tried as fans about each of them
# Corners squared, summed over the polygons that lose ears, as their time grows; half a minute where all are spirals.
_MOST_WORK = 1 << 25
_AT_ONCE = 1 << 20  # corners that are looked at together, which bounds the work space


@dataclass(frozen=True, eq=False)
class Triangles:
    """Polygons that are cut into triangles.

    Attributes:
        faces: (M, 3) vertex indices; a convex polygon (a, b, c, d) gives (a, b, c), (a, c, d).
        corners: (M, 3) places of the same corners in the flat list of all corners.
        polygons: (M,) polygon of each triangle.
        count: number of polygons.
    """

    faces: Int64[np.ndarray, "M 3"]
    corners: Int64[np.ndarray, "M 3"]
    polygons: Int64[np.ndarray, " M"]
    count: int

    @property
    def source_faces(self) -> Int64[np.ndarray, " M"] | None:
        """Polygon of each triangle, None if every polygon is one triangle."""
        return None if np.array_equal(self.polygons, np.arange(self.count)) else self.polygons


def cut_polygons(
    corners: Integer[np.ndarray, " C"],
    sizes: Integer[np.ndarray, " F"],
    vertices: Float64[np.ndarray, "N 3"],
    *,
    subject: str,
) -> Triangles:
    """Cut polygons into triangles, in their order and winding; those of fewer than three corners are left out.

    A polygon that one of its corners sees whole becomes a fan about that corner: the first one of a convex polygon.
    All others lose ears until a triangle is left (Meisters 1975), in the plane of their Newell normal.

    Args:
        corners: (C,) vertex indices of all polygons, concatenated.
        sizes: (F,) number of corners of each polygon, which sum to C.
        vertices: (N, 3) places; polygons with others' indices are cut as if they were convex.
        subject: name of the file in the warnings.

    Warns:
        GeometryWarning: polygons of fewer than three corners, and those that cross themselves.
    """
    few = int((sizes < 3).sum())
    if few:
        warn(f"{subject}: {few} faces with fewer than three corners are left out")
    # The first corner of each polygon in the concatenated list; one of n corners gives n - 2 triangles (0, k, k + 1).
    first = (np.cumsum(sizes) - sizes).astype(np.int64)
    count = np.maximum(sizes.astype(np.int64) - 2, 0)
    polygons = np.repeat(np.arange(len(sizes), dtype=np.int64), count)
    step = np.arange(len(polygons), dtype=np.int64) - np.repeat(np.cumsum(count) - count, count)
    local = np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    # Polygons that their first corner does not see whole are cut otherwise, size by size.
    begin, crossing, work = np.cumsum(count) - count, 0, _MOST_WORK
    for size in np.unique(sizes[sizes > 3]):
        rows = np.flatnonzero(sizes == size)
        index = corners[first[rows][:, None] + np.arange(size)].astype(np.int64)
        known = ((index >= 0) & (index < len(vertices))).all(axis=1)
        rows, index = rows[known], index[known]
        for some in np.array_split(np.arange(len(rows)), max(1, len(rows) * int(size) // _AT_ONCE)):
            cut, chosen, crossed = _concave(vertices[index[some]], most=work // int(size) ** 2)
            work -= len(chosen) * int(size) ** 2
            crossing += crossed
            local[begin[rows[some[chosen]]][:, None] + np.arange(size - 2)] = cut
    if crossing:
        warn(f"{subject}: {crossing} polygons that cross themselves, or are too many, are cut about one corner")
    places = first[polygons][:, None] + local
    return Triangles(corners.astype(np.int64)[places].reshape(-1, 3), places, polygons, len(sizes))


def _concave(
    points: Float64[np.ndarray, "P n 3"], *, most: int
) -> tuple[Int64[np.ndarray, "Q m 3"], Int64[np.ndarray, " Q"], int]:
    """Cut the polygons of n corners that are no fan about their first corner, of those without any fan `most`.

    Returns:
        (Q, n - 2, 3) local corners of their triangles, which of the P polygons they are, and how many could not be cut.
    """
    size = points.shape[1]
    with np.errstate(all="ignore"):
        # Newell: the sum of cross products of neighbours is twice the area along the normal, also where it bends.
        relative = points - points[:, :1]
        normal = np.cross(relative, np.roll(relative, -1, axis=1)).sum(axis=1)
        area = np.linalg.norm(normal, axis=1)
        axis = normal / area[:, None]

        def seen(start: Int64[np.ndarray, " K"], rows: Int64[np.ndarray, " K"]) -> Float64[np.ndarray, " K"]:
            """Return the least signed area of a fan's triangles about a corner, as a share of the polygon's."""
            order = (start[:, None] + np.arange(size)) % size
            turned = relative[rows[:, None], order]
            spokes = turned[:, 1:] - turned[:, :1]
            doubled = np.einsum("pka,pa->pk", np.cross(spokes[:, :-1], spokes[:, 1:]), axis[rows])
            return doubled.min(axis=1) / area[rows]

        every = np.arange(len(points))
        left = every[seen(np.zeros(len(points), np.int64), every) < -_SHARE]  # false for NaN, which the repair removes
        chosen, cut = [], []
        fan = np.stack([np.zeros(size - 2, np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
        for start in range(1, size if size <= _STARTS else 1):
            whole = seen(np.full(len(left), start), left) >= -_SHARE
            chosen.append(left[whole])
            cut.append(np.repeat((fan[None] + start) % size, int(whole.sum()), axis=0))
            left = left[~whole]
    crossed = 0
    for k, row in enumerate(left):
        triangles = _clip_ears(_in_plane(relative[row], axis[row])) if k < most else None
        if triangles is None:
            crossed += 1
        else:
            chosen.append(np.array([row]))
            cut.append(triangles[None])
    if not chosen:
        return np.zeros((0, size - 2, 3), np.int64), np.zeros(0, np.int64), crossed
    return np.concatenate(cut), np.concatenate(chosen), crossed


def _in_plane(points: Float64[np.ndarray, "n 3"], normal: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "*n"]:
    """Return coordinates in the plane across a normal, counter-clockwise as seen against it."""
    x = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    x /= np.linalg.norm(x)
    return points @ np.stack([x, np.cross(normal, x)], axis=1)


def _clip_ears(points: Float64[np.ndarray, "n 2"]) -> Int64[np.ndarray, "m 3"] | None:
    """Cut a simple counter-clockwise polygon into triangles by its ears; None where a corner is left without one."""
    left = list(range(len(points)))
    out = []
    least = -1e-12 * float(np.ptp(points, axis=0).max()) ** 2
    while len(left) > 3:
        here = points[left]
        before, after = np.roll(here, 1, axis=0), np.roll(here, -1, axis=0)
        area = _doubled(before, here, after)
        # Ears turn to the left and hold no other corner; the widest first, so that slivers are few.
        for k in np.argsort(-area):
            if area[k] < least:
                return None
            a, b, c = before[k], here[k], after[k]
            others = np.delete(here, [(k - 1) % len(left), k, (k + 1) % len(left)], axis=0)
            # A corner at the place of one of the ear's lies outside (polygons that touch themselves).
            others = others[~((others == a).all(axis=1) | (others == c).all(axis=1))]
            inside = (_doubled(a, b, others) >= 0) & (_doubled(b, c, others) >= 0) & (_doubled(c, a, others) >= 0)
            if not inside.any():
                break
        else:
            return None
        out.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        del left[k]
    out.append((left[0], left[1], left[2]))
    return np.array(out, dtype=np.int64)


def _doubled(
    a: Float64[np.ndarray, "*a 2"], b: Float64[np.ndarray, "*b 2"], c: Float64[np.ndarray, "*c 2"]
) -> Float64[np.ndarray, "*n"]:
    """Return twice the signed area of triangles."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
