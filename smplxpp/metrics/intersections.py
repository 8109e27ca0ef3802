"""Measure how far one layer penetrates another, and find pairs of faces of one mesh that cut through each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core import InputError, MeshLike, PointsLike, as_array, as_mesh, as_points, require_at_least
from smplxpp.core.errors import one_line
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.solids import solid_of_mesh
from smplxpp.metrics.comparison import MM

CM3 = 1e6
"""Cubic centimetres in a cubic metre."""


@dataclass(frozen=True, eq=False)
class PenetrationReport:
    """Points of an outer layer against an inner surface.

    Attributes:
        count: points nearer to the inside than `clearance_mm` asks.
        fraction: of all points.
        depth_mean_mm, depth_max_mm: of the missing distance `clearance - signed distance` over those points; 0 if none.
        clearance_mm: asked for.
        signed_distance: (N,) float64 metres, negative inside.
        penetrating: (N,) bool.
    """

    count: int
    fraction: float
    depth_mean_mm: float
    depth_max_mm: float
    clearance_mm: float
    signed_distance: Float64[np.ndarray, " N"]
    penetrating: Bool[np.ndarray, " N"]

    __repr__ = one_line

    def as_dict(self) -> dict:
        """Return the scalar figures as a dictionary for JSON."""
        names = ("count", "fraction", "depth_mean_mm", "depth_max_mm", "clearance_mm")
        return {name: getattr(self, name) for name in names}


def signed_distance(
    points: PointsLike, mesh: MeshLike
) -> tuple[Float64[np.ndarray, " P"], Float64[np.ndarray, "P 3"], Int64[np.ndarray, " P"]]:
    """Signed distance (P,) of (P, 3) points to `mesh`, negative inside; closest points (P, 3) and faces (P,).

    Inside is where the generalised winding number is above 1/2, the distance is to the outer surface
    (`SignedDistanceField`): a body has open borders, eyes and teeth inside the head and limbs that overlap, where the
    normal of the closest face answers wrongly.

    Raises:
        InputError: NaN or infinite points, another shape, a mesh without area or wound inside out.
    """
    mesh = as_mesh(mesh, subject="mesh")
    found = SignedDistanceField(mesh, solid=True).query(as_points(points)[0])
    return found.distance, found.closest, found.face


def penetration(outer: PointsLike, inner: MeshLike, *, clearance: float = 0.0) -> PenetrationReport:
    """How far vertices of `outer` (a mesh, or points (N, 3)) lie inside `inner` or nearer than `clearance` metres.

    Raises:
        InputError: no points, as `signed_distance`, or a clearance that is negative or not finite.
    """
    # Nearer to the surface than this share of the mesh's size the sign of the distance is rounding.
    sign_resolution = 1e-6
    inner = as_mesh(inner, subject="inner mesh")
    points = as_array(outer) if isinstance(outer, np.ndarray) else as_points(outer, subject="outer layer")[0]
    if not len(points):
        raise InputError("outer layer", expected="points", received="none")
    require_at_least("clearance in metres", clearance, 0.0)
    signed, _, _ = signed_distance(points, inner)
    # A margin relative to the size of the mesh, below which the sign of a distance is round-off.
    penetrating = signed < clearance - sign_resolution * inner.bbox_diagonal
    depth = (clearance - signed[penetrating]) * MM
    return PenetrationReport(
        count=int(penetrating.sum()),
        fraction=float(penetrating.mean()),
        depth_mean_mm=float(depth.mean()) if len(depth) else 0.0,
        depth_max_mm=float(depth.max(initial=0.0)),
        clearance_mm=clearance * MM,
        signed_distance=signed,
        penetrating=penetrating,
    )


@dataclass(frozen=True)
class Interpenetration:
    """Volume and surface that two solids share.

    Attributes:
        volume_cm3: of what lies in both.
        share: of the smaller one's volume; 0 where it has none.
        volume_a_cm3, volume_b_cm3: of the two.
    """

    volume_cm3: float
    share: float
    volume_a_cm3: float
    volume_b_cm3: float

    def as_dict(self) -> dict:
        """Return the numbers as a dictionary for JSON."""
        return asdict(self)


def interpenetration(a: MeshLike, b: MeshLike) -> Interpenetration:
    """The volume of the intersection of two closed meshes in metres.

    An open surface has no volume: give it a thickness first (`smplxpp.clean.thickened`), or close it. Where a surface
    cuts itself, what it encloses twice counts once or twice.

    Raises:
        InputError: a mesh that is open, not manifold, or encloses nothing.
    """
    a = as_mesh(a, subject="first surface")
    b = as_mesh(b, subject="second surface")
    first, second = solid_of_mesh(a, subject="first surface"), solid_of_mesh(b, subject="second surface")
    shared = max((first ^ second).volume(), 0.0)
    smaller = min(first.volume(), second.volume())
    return Interpenetration(
        volume_cm3=shared * CM3,
        share=shared / smaller if smaller > 0 else 0.0,
        volume_a_cm3=first.volume() * CM3,
        volume_b_cm3=second.volume() * CM3,
    )


# A crossing nearer to an edge or a plane than this share of the triangle's size is touching, not cutting.
TOLERANCE = 1e-9
PAIRS_AT_ONCE = 500_000


def self_intersections(mesh: MeshLike) -> Int64[np.ndarray, "P 2"]:
    """The pairs of faces, lower index first, sorted, where an edge of one passes through the inside of the other.

    Faces that share an edge are neighbours and never a pair; touching and overlap in one plane are not counted.
    Candidates come from a uniform grid over the faces' boxes; the test is that of edges against triangles.
    """
    mesh = as_mesh(mesh, subject="mesh")
    triangles = mesh.triangles
    found = [np.zeros((0, 2), dtype=np.int64)]
    for pairs in _candidate_pairs(triangles):
        # Faces with two common vertices share an edge; one common vertex does not exclude a true intersection.
        shared = (mesh.faces[pairs[:, 0]][:, :, None] == mesh.faces[pairs[:, 1]][:, None, :]).sum(axis=(1, 2))
        pairs = pairs[shared < 2]
        # Cheap rejection first: a triangle that cuts another has corners on both sides of the other's plane.
        pairs = pairs[_straddles(triangles[pairs[:, 0]], triangles[pairs[:, 1]])]
        cut = np.zeros(len(pairs), dtype=bool)
        # Triangles intersect if an edge of either passes through the inside of the other.
        for a, b in ((0, 1), (1, 0)):
            for k in range(3):
                start, end = triangles[pairs[:, a], k], triangles[pairs[:, a], (k + 1) % 3]
                cut |= _edge_cuts_triangle(start, end, triangles[pairs[:, b]])
        found.append(pairs[cut])
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _straddles(moving: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """(P,) bool: triangle `moving` has corners on both sides of the plane of triangle `plane`, both (P, 3, 3)."""
    normal = np.cross(plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0])
    offset = moving - plane[:, :1]
    height = np.einsum("pkd,pd->pk", offset, normal)
    touching = TOLERANCE * np.sqrt(np.einsum("pd,pd->p", normal, normal) * np.einsum("pkd,pkd->p", offset, offset))
    return (height.min(axis=1) < -touching) & (height.max(axis=1) > touching)


def _edge_cuts_triangle(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """(P,) bool: edge from `start` to `end` (P, 3) crosses the interior of `triangle` (P, 3, 3)."""
    u, v = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    normal = np.cross(u, v)
    direction = end - start
    from_corner = start - triangle[:, 0]
    area2 = np.einsum("ij,ij->i", normal, normal)
    slope = np.einsum("ij,ij->i", direction, normal)
    height = np.einsum("ij,ij->i", from_corner, normal)
    # Moeller and Trumbore 1997, with the edge's own parameter held inside (0, 1).
    q = np.cross(from_corner, direction)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -height / slope
        beta = -np.einsum("ij,ij->i", v, q) / slope
        gamma = np.einsum("ij,ij->i", u, q) / slope
        inside = (beta > TOLERANCE) & (gamma > TOLERANCE) & (beta + gamma < 1 - TOLERANCE)
    steep = np.abs(slope) > TOLERANCE * np.sqrt(area2) * np.linalg.norm(direction, axis=1)
    return steep & inside & (t > TOLERANCE) & (t < 1 - TOLERANCE)


def _candidate_pairs(triangles: np.ndarray) -> Iterator[np.ndarray]:
    """Chunks of (P, 2) pairs of faces whose boxes overlap, lower index first, each pair once."""
    if len(triangles) < 2:
        return
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    face, cell, size, origin = _faces_in_cells(low, high)
    order = np.argsort(cell, kind="stable")
    face, cell = face[order], cell[order]
    _, start, count = np.unique(cell, return_index=True, return_counts=True)
    # Each entry is paired with those behind it in its cell.
    behind = np.repeat(start + count, count) - np.arange(len(face)) - 1
    ends = np.cumsum(behind)
    inner = np.searchsorted(ends, np.arange(PAIRS_AT_ONCE, ends[-1], PAIRS_AT_ONCE))
    for first, last in pairwise([0, *inner.tolist(), len(face)]):
        entries = np.arange(first, last)
        n = behind[entries]
        left = np.repeat(entries, n)
        right = left + 1 + np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        i, j = face[left], face[right]
        corner = np.maximum(low[i], low[j])
        overlap = (corner <= np.minimum(high[i], high[j])).all(axis=1)
        # Of all the cells that two boxes share, the one that holds the low corner of their overlap reports the pair.
        own = _cell_key(np.floor((corner - origin) / size).astype(np.int64)) == cell[left]
        keep = overlap & own
        yield np.stack([np.minimum(i, j), np.maximum(i, j)], axis=1)[keep]


def _faces_in_cells(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """(K,) face and cell of every cell that a face's box touches; the cells' size and the grid's origin."""
    origin = low.min(axis=0)
    extent = float((high.max(axis=0) - origin).max())
    size = max(2.0 * float((high - low).max(axis=1).mean()), extent / 2**19, np.finfo(float).tiny)
    while True:
        first = np.floor((low - origin) / size).astype(np.int64)
        span = np.floor((high - origin) / size).astype(np.int64) - first + 1
        cells = span.prod(axis=1)
        # A few huge faces among many small ones would fill the grid alone.
        if cells.sum() <= 32 * len(low):
            break
        size *= 2.0
    face = np.repeat(np.arange(len(low)), cells)
    local = np.arange(len(face)) - np.repeat(np.cumsum(cells) - cells, cells)
    sx, sy = span[face, 0], span[face, 1]
    offset = np.stack([local % sx, local // sx % sy, local // (sx * sy)], axis=1)
    return face, _cell_key(first[face] + offset), size, origin


def _cell_key(ijk: np.ndarray) -> np.ndarray:
    return (ijk[:, 0] << 42) | (ijk[:, 1] << 21) | ijk[:, 2]
