"""Place a garment along limbs: cut it by planes across one into rings, and tell tubes that a scan has fused apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.topology import component_labels
from smplxpp.transfer.anchors import smooth_step

_CLOSED = 0.99
"""Least share of a turn about the axis that a ring has to make: a plane that leaves through a hem makes no ring."""
_NARROW, _WIDEST = 0.75, 0.97
"""Widths of necks over their lobes: of trouser legs that touch, near the crotch, and of any farther out. Skirts of the
garments have none below 1.0, the simulated one of the embedded person none below 0.82."""
_LONG = 20
"""Planes (36 cm) with a neck from which on a shallow groove is that between two legs. The skirt of a dancer's scan is
drawn in between her striding legs over ten, the more the farther down."""


@dataclass(frozen=True, eq=False)
class LimbAxis:
    """A polyline through the middle of a limb, and the mean weights of the skin around it.

    Attributes:
        joints: indices of the joints that the limb consists of.
        points: metres, from the trunk outwards, evenly spaced.
        tangents: unit length.
        weights: mean weights of the limb's skin at each point.
        whole: points of the axis as it counts for the rings of other limbs: a leg's continues to the floor.
    """

    joints: tuple[int, ...]
    points: Float64[np.ndarray, "K 3"]
    tangents: Float64[np.ndarray, "K 3"]
    weights: Float64[np.ndarray, "K J"]
    whole: Float64[np.ndarray, "L 3"]


@dataclass(frozen=True, eq=False)
class Neck:
    """The narrowest place of a ring between two axes.

    Attributes:
        point: on the line from the limb's axis to the other one.
        direction: unit vector along it.
        width: over that of the narrower lobe, on the side where it is less narrow.
        place: its distance from the limb's axis as a share of that between both axes.
    """

    point: np.ndarray
    direction: np.ndarray
    width: float
    place: float


@dataclass(frozen=True, eq=False)
class Ring:
    """A ring around a limb's axis: the vertices of its faces, which others it goes around, too, and its neck.

    `slack` is what folds hide of its radius: that of a circle as long as the ring less that of one as long as its hull,
    metres.
    """

    corners: np.ndarray
    holds: tuple[int, ...]
    neck: Neck | None
    slack: float


def rings_around(
    mesh: TriangleMesh,
    axis: LimbAxis,
    others: list[LimbAxis],
    *,
    closed: float = _CLOSED,
) -> list[tuple[int, Ring]]:
    """Return the rings around a limb's axis in which the planes across it cut a part, each with its plane's number.

    Args:
        mesh: the part.
        axis: the limb's; plane i goes through its point i.
        others: axes of other limbs and of the trunk.
        closed: least share of a turn about the axis that a ring makes.
    """
    # The faces that each plane cuts, of all planes at once: one graph is quicker than many.
    side = heights(axis, mesh)
    over = side > 0
    # Planes that leave all vertices on one side cut nothing.
    reached = np.flatnonzero(over.any(axis=1) & ~over.all(axis=1))
    first, second, third = (over[reached][:, mesh.faces[:, corner]] for corner in range(3))
    cut = (first != second) | (first != third)
    plane, face = np.nonzero(cut & (np.count_nonzero(cut, axis=1) > 2)[:, None])
    if not len(plane):
        return []
    plane = reached[plane]
    faces = mesh.faces[face]
    above = over[plane[:, None], faces]
    # The two edges of each face that cross the plane: those at the corner that is alone on its side.
    odd = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(plane))
    a, b, c = faces[rows, odd], faces[rows, (odd + 1) % 3], faces[rows, (odd + 2) % 3]
    flip = above[rows, odd]
    p, q = (_crossing(mesh.vertices, side, plane, a, end) for end in (b, c))
    # Segments hang together where they share a crossed edge of one plane.
    key = np.stack([np.minimum(a, end) * mesh.vertex_count + np.maximum(a, end) for end in (b, c)], axis=1)
    node = np.unique(plane[:, None] * mesh.vertex_count**2 + key, return_inverse=True)[1].reshape(-1, 2)
    ring = component_labels(node, int(node.max()) + 1)[node[:, 0]]
    # The angle of every ring as seen from the axis, wound in one sense all around.
    start, end = np.where(flip[:, None], p, q), np.where(flip[:, None], q, p)
    tangent = axis.tangents[plane]
    turn = np.bincount(ring, _angle(start - axis.points[plane], end - axis.points[plane], tangent))
    around = np.abs(turn) > closed * 2 * np.pi
    chosen = around[ring]
    ring, plane, faces, start, end, tangent = (x[chosen] for x in (ring, plane, faces, start, end, tangent))
    # Another axis is within the ring if that goes around it, too, be it with a gap where the plane grazes a hem.
    held: dict[int, list[tuple[int, np.ndarray]]] = {k: [] for k in np.flatnonzero(around).tolist()}
    for number, other in enumerate(others):
        for at in _piercings_of_planes(other.whole, axis):
            seen = np.flatnonzero(np.isfinite(at[plane, 0]))
            point = at[plane[seen]]
            turn = np.bincount(ring[seen], _angle(start[seen] - point, end[seen] - point, tangent[seen]))
            for k in np.flatnonzero(np.abs(turn) > np.pi).tolist():
                held[k].append((number, at[plane[np.argmax(ring == k)]]))
    out = []
    for k, inside in held.items():
        own = np.flatnonzero(ring == k)
        i, neck = int(plane[own[0]]), None
        if len(inside) == 1:
            neck = _neck(np.concatenate([start[own], end[own]]), axis.points[i], inside[0][1], axis.tangents[i])
        slack = _slack(start[own], end[own], axis.tangents[i])
        out.append((i, Ring(np.unique(faces[own]), tuple(number for number, _ in inside), neck, slack)))
    return sorted(out, key=lambda pair: pair[0])


def heights(axis: LimbAxis, mesh: TriangleMesh) -> Float64[np.ndarray, "K N"]:
    """Return the height of each vertex over each of a limb's planes, metres."""
    return axis.tangents @ mesh.vertices.T - np.einsum("ij,ij->i", axis.tangents, axis.points)[:, None]


def depth_below_hips(vertices: Float[np.ndarray, "N 3"], legs: list[LimbAxis]) -> Float64[np.ndarray, " N"]:
    """Return the height of vertices below the hip joints, along the nearest leg, metres; negative above them."""
    depth, nearest = np.zeros(len(vertices)), np.full(len(vertices), np.inf)
    for axis in legs:
        own, index = cKDTree(axis.points).query(vertices)
        along = np.einsum("ij,ij->i", vertices - axis.points[index], axis.tangents[index])
        # Between the axis' ends its nearest point says the height, outside them the continued line.
        outside = (index == 0) | (index == len(axis.points) - 1)
        height = index * row_lengths(axis.points[1:2] - axis.points[:1]) + np.where(outside, along, 0.0)
        depth = np.where(own < nearest, height, depth)
        nearest = np.minimum(own, nearest)
    return depth


def behind_legs(vertices: Float[np.ndarray, "N 3"], axes: list[LimbAxis]) -> Float64[np.ndarray, " N"]:
    """Return how far behind its nearest leg a vertex lies: 1 straight behind it, 0 from beside it forwards."""
    offset, nearest = np.zeros((len(vertices), 3)), np.full(len(vertices), np.inf)
    for axis in axes[:2]:
        own, index = cKDTree(axis.points).query(vertices)
        closer = own < nearest
        offset[closer], nearest[closer] = (vertices - axis.points[index])[closer], own[closer]
    back = -normalize_rows(offset) @ body_directions(axes)[2]
    return smooth_step(back, 0.0, 0.7)


def body_directions(axes: list[LimbAxis]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unit vectors to the body's left, upwards and forwards, by the axes of legs and trunk."""
    side, up = axes[0].points[0] - axes[1].points[0], axes[-1].points[-1] - axes[-1].points[0]
    side /= np.linalg.norm(side)
    front = np.cross(side, up)
    front /= np.linalg.norm(front)
    return side, np.cross(front, side), front


def _slack(start: np.ndarray, end: np.ndarray, tangent: np.ndarray) -> float:
    """Return how much larger a circle as long as a ring of segments is than one as long as its convex hull, metres."""
    # The hull is as long as the integral of its support function over all directions.
    count = 64
    across = np.cross(tangent, np.eye(3)[np.abs(tangent).argmin()])
    across /= np.linalg.norm(across)
    turn = 2.0 * np.pi * np.arange(count) / count
    directions = np.outer(np.cos(turn), across) + np.outer(np.sin(turn), np.cross(tangent, across))
    return float(row_lengths(end - start).sum() / (2.0 * np.pi) - (start @ directions.T).max(axis=0).mean())


def _neck(points: np.ndarray, own: np.ndarray, other: np.ndarray, tangent: np.ndarray) -> Neck | None:
    """Return the neck of a ring around two axes, None where it has none between them."""
    distance = np.linalg.norm(other - own)
    direction = (other - own) / distance
    place, side = (points - own) @ direction / distance, (points - own) @ np.cross(tangent, direction)
    # How far the ring reaches to either side of the line through both axes, in slices of a tenth of the distance.
    slices = np.floor(10.0 * place).astype(int)
    reach: dict[int, np.ndarray] = {}
    for k in np.unique(slices).tolist():
        here = side[slices == k]
        if here.min() < 0 < here.max():
            reach[k] = np.array([here.max(), -here.min()])
    between = [k for k in range(2, 8) if k in reach]
    if not between:
        return None
    at = min(between, key=lambda k: float(reach[k].sum()))
    lobes = [[values for k, values in reach.items() if chosen(k)] for chosen in (lambda k: k < at, lambda k: k > at)]
    if not all(lobes):
        return None
    width = (reach[at] / np.minimum(*(np.max(lobe, axis=0) for lobe in lobes))).max()
    middle = 0.1 * (at + 0.5)
    return Neck(own + middle * (other - own), direction, float(width), middle)


@dataclass(frozen=True, eq=False)
class Septum:
    """The wall between a limb and another one that a scan has fused into one tube, by plane across the limb.

    Attributes:
        first: the first plane that cuts both.
        points: (K, 3) on the wall, one for each of the limb's planes.
        directions: (K, 3) unit vectors from the limb through the wall.
    """

    first: int
    points: Float64[np.ndarray, "K 3"]
    directions: Float64[np.ndarray, "K 3"]

    def past(self, points: np.ndarray, plane: np.ndarray) -> Float64[np.ndarray, " N"]:
        """Return how far points at the given planes lie past the wall, metres; negative on the limb's side."""
        k = np.clip(np.rint(plane).astype(int), 0, len(self.points) - 1)
        return np.einsum("ij,ij->i", points - self.points[k], self.directions[k])


def septum_of(rings: list[tuple[int, Ring]], count: int, *, first: int | None = None) -> Septum | None:
    """Return the wall between two limbs whose tubes a scan has fused, None where it has not.

    Trouser legs that touch are one surface in a scan: its rings have the shape of an eight. Where some have a narrow
    neck, all rings farther out are of two tubes, as legs do not merge again; those of a skirt are wide everywhere.

    Args:
        rings: around a limb, with their planes.
        count: of the limb's planes.
        first: the first plane of two tubes, where it is known. None: found by the necks.
    """
    necks = sorted(((i, ring.neck) for i, ring in rings if ring.neck is not None), key=lambda pair: pair[0])
    first = _fused_from(necks) if first is None else first
    grooved = [(i, neck) for i, neck in necks if first is not None and i >= first and neck.width <= _WIDEST]
    if first is None or not grooved:
        return None
    planes = np.array([i for i, _ in grooved])
    # Pleats move the narrowest place from plane to plane: the median of the wall over nine planes stays.
    near = [np.abs(planes - k) <= 4 for k in range(count)]
    rows = [np.flatnonzero(own) if own.any() else [int(np.abs(planes - k).argmin())] for k, own in enumerate(near)]
    points = np.stack([np.median([grooved[r][1].point for r in own], axis=0) for own in rows])
    directions = np.stack([np.mean([grooved[r][1].direction for r in own], axis=0) for own in rows])
    return Septum(first, points, normalize_rows(directions))


def _fused_from(necks: list[tuple[int, Neck]]) -> int | None:
    """Return the first plane from which on rings are of two fused tubes, by the planes' necks."""
    # Legs touch midway between their axes, give or take a slice; folds of a long skirt lie anywhere, most beside a leg.
    central = [(i, neck) for i, neck in necks if abs(neck.place - 0.5) < 0.2]
    narrow = [i for i, neck in central if neck.width < _NARROW]
    if len(narrow) >= 3:
        return min(narrow)
    # Pleats hide the groove between the legs of a hakama, which is shallow but runs from the crotch to the hem.
    grooved = [i for i, neck in central if neck.width < _WIDEST]
    midway = abs(np.median([neck.place for _, neck in central if neck.width < _WIDEST] or [0.0]) - 0.5) < 0.1
    if len(grooved) < _LONG or not midway:
        return None
    onwards = [neck.width for i, neck in necks if i >= grooved[0]]
    # Of a skirt between striding legs it gets deeper towards the hem.
    _, middle, last = np.array_split(onwards, 3)
    whole = len(grooved) > 0.8 * len(onwards) and last.mean() > middle.mean() - 0.02
    return grooved[0] if whole else None


def _crossing(vertices: np.ndarray, side: np.ndarray, plane: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return where the edges from a to b cross their planes."""
    t = side[plane, a] / (side[plane, a] - side[plane, b])
    return vertices[a] + t[:, None] * (vertices[b] - vertices[a])


def _piercings_of_planes(points: np.ndarray, axis: LimbAxis) -> Iterator[np.ndarray]:
    """Yield where a polyline crosses the planes across an axis (K, 3) for the first time, the second, and so on."""
    side = (points @ axis.tangents.T - np.einsum("ij,ij->i", axis.tangents, axis.points)).T
    crossed = (side[:, :-1] > 0) != (side[:, 1:] > 0)
    while crossed.any():
        out = np.full((len(side), 3), np.nan)
        rows = np.flatnonzero(crossed.any(axis=1))
        k = crossed[rows].argmax(axis=1)
        t = side[rows, k] / (side[rows, k] - side[rows, k + 1])
        out[rows] = points[k] + t[:, None] * (points[k + 1] - points[k])
        crossed[rows, k] = False
        yield out


def piercings(points: np.ndarray, point: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return where a polyline crosses the plane."""
    side = (points - point) @ tangent
    k = np.flatnonzero((side[:-1] > 0) != (side[1:] > 0))
    t = side[k] / (side[k] - side[k + 1])
    return points[k] + t[:, None] * (points[k + 1] - points[k])


def _angle(u: np.ndarray, v: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the signed angles from u to v about the axes, all across them."""
    return np.arctan2(np.einsum("ij,ij->i", np.cross(u, v), axis), np.einsum("ij,ij->i", u, v))
