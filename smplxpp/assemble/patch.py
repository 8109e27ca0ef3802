"""A hole's patch: the least surface over a border loop, with faces as small as those around it (Liepa 2003)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int, Int64

from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh, row_lengths
from smplxpp.core.topology import edge_groups, half_edges

LONGEST = 400
"""Vertices of a border at most: time grows with their cube."""
_ROUNDS = 12
_MOST = 1000  # new vertices, about
_SPACING = 2.0**0.5  # Liepa's density factor


@dataclass(frozen=True, eq=False)
class Patch:
    """What closes a border loop of L vertices.

    Attributes:
        faces: (F, 3), turned as the mesh around; 0 to L - 1 are the loop's vertices in order, K new ones follow.
        from_rim: (K, L) float64, rows sum to 1: a new vertex's place, colour or weights from those of the loop's. The
            mean of its neighbours' (discrete harmonic), so that nothing goes beyond what the rim has.
    """

    faces: Int64[np.ndarray, "F 3"]
    from_rim: Float64[np.ndarray, "K L"]

    def places(self, rim: Float[np.ndarray, "L 3"]) -> Float64[np.ndarray, "N 3"]:
        """The loop's vertices, then the new ones."""
        return np.concatenate([rim, self.from_rim @ rim])

    def area(self, rim: Float[np.ndarray, "L 3"]) -> float:
        """Square metres."""
        return float(TriangleMesh(self.places(rim), self.faces).face_areas.sum())

    def width(self, rim: Float[np.ndarray, "L 3"]) -> float:
        """Twice the area by the border's length, metres: how wide a long slit is in the mean, a disc's radius."""
        return 2.0 * self.area(rim) / float(row_lengths(np.roll(rim, -1, axis=0) - rim).sum())


def patch_loop(mesh: TriangleMesh, loop: Int[np.ndarray, " L"]) -> Patch:
    """Close a border loop of a manifold mesh (`smplxpp.core.topology.border_loops`).

    The loop is triangulated with the least area (Barequet and Sharir 1995); triangles larger than the rim's edges are
    split, edges turned until they are Delaunay's (Liepa, *Filling holes in meshes*, SGP 2003), and new vertices go to
    the mean of their neighbours. Two vertices of the loop with an edge outside get none within.

    Raises:
        InputError: fewer than 3 or more than `LONGEST` vertices, or a loop that only an edge which exists could close.
    """
    count = len(loop)
    if not 3 <= count <= LONGEST:
        raise InputError("hole", expected=f"a border of 3 to {LONGEST} vertices", received=str(count))
    rim = mesh.vertices[loop]
    taken = _chords(mesh.faces, loop)
    faces = _least_area(rim, taken)
    around = row_lengths(np.roll(rim, -1, axis=0) - rim)
    # A border of many tiny edges does not ask for as tiny faces all over.
    least = (sum(_area(*rim[list(face)]) for face in faces) / _MOST) ** 0.5
    spacing = list(np.maximum(0.5 * (around + np.roll(around, 1)), least))
    places = list(rim)
    for _ in range(_ROUNDS):
        if not _split(faces, places, spacing):
            break
        _turn(faces, np.array(places), taken)
    triangles = np.array(faces, dtype=np.int64)
    return Patch(triangles, _harmonic(triangles, count, len(places)))


def _chords(faces: Int[np.ndarray, "M 3"], loop: Int[np.ndarray, " L"]) -> set[tuple[int, int]]:
    """Pairs of places in the loop, lower first, between which the mesh has an edge."""
    at = np.full(int(faces.max()) + 1, -1)
    at[loop] = np.arange(len(loop))
    ends = np.sort(at[half_edges(faces)], axis=1)
    return {(int(a), int(b)) for a, b in ends[ends[:, 0] >= 0]}


def _least_area(rim: Float[np.ndarray, "L 3"], taken: set[tuple[int, int]]) -> list[tuple[int, int, int]]:
    """The triangulation of a loop with the least area, by dynamic programming over its diagonals."""
    count = len(rim)
    cost, middle = np.full((count, count), np.inf), np.zeros((count, count), dtype=np.int64)
    cost[np.arange(count - 1), np.arange(1, count)] = 0.0
    for gap in range(2, count):
        for i in range(count - gap):
            j = i + gap
            if (i, j) in taken and gap != count - 1:
                continue
            k = np.arange(i + 1, j)
            area = 0.5 * row_lengths(np.cross(rim[k] - rim[i], rim[j] - rim[i]))
            total = cost[i, k] + cost[k, j] + area
            best = int(np.argmin(total))
            cost[i, j], middle[i, j] = total[best], k[best]
    if not np.isfinite(cost[0, count - 1]):
        raise InputError("hole", expected="a border that faces can close", received="one with edges across it")
    faces: list[tuple[int, int, int]] = []
    sides = [(0, count - 1)]
    while sides:
        low, high = sides.pop()
        if high - low >= 2:
            between = int(middle[low, high])
            faces.append((high, between, low))  # against the border's direction
            sides += [(low, between), (between, high)]
    return faces


def _split(faces: list[tuple[int, int, int]], places: list[np.ndarray], spacing: list[float]) -> bool:
    """Put a vertex into the middle of each face that is wider than the edges around; whether there was one."""
    before = len(faces)
    for index in range(before):
        corners = faces[index]
        middle = np.mean([places[c] for c in corners], axis=0)
        wanted = float(np.mean([spacing[c] for c in corners]))
        reach = [_SPACING * float(np.linalg.norm(middle - places[c])) for c in corners]
        if any(r <= max(wanted, spacing[c]) for r, c in zip(reach, corners, strict=True)):
            continue
        new = len(places)
        places.append(middle)
        spacing.append(wanted)
        a, b, c = corners
        faces[index] = (a, b, new)
        faces += [(b, c, new), (c, a, new)]
    return len(faces) > before


def _turn(faces: list[tuple[int, int, int]], places: Float[np.ndarray, "N 3"], taken: set[tuple[int, int]]) -> None:
    """Turn inner edges whose two opposite angles are together more than a straight one, until there is none."""
    beside: dict[tuple[int, int], int] = {}  # the face with the directed edge
    for index, face in enumerate(faces):
        beside.update({(face[k], face[(k + 1) % 3]): index for k in range(3)})
    todo = [edge for edge in beside if edge[0] < edge[1] and edge[::-1] in beside]
    budget = 20 * len(faces)
    while todo and budget:
        budget -= 1
        a, b = todo.pop()
        if (a, b) not in beside or (b, a) not in beside:
            continue
        first, second = beside[a, b], beside[b, a]
        (c,), (d,) = set(faces[first]) - {a, b}, set(faces[second]) - {a, b}
        low, high = min(c, d), max(c, d)
        if (low, high) in taken or (c, d) in beside or (d, c) in beside:
            continue
        if _angle(places[c], places[a], places[b]) + _angle(places[d], places[a], places[b]) <= np.pi + 1e-9:
            continue
        del beside[a, b], beside[b, a]
        faces[first], faces[second] = (a, d, c), (d, b, c)
        beside.update({(a, d): first, (d, c): first, (c, a): first, (d, b): second, (b, c): second, (c, d): second})
        todo += [(a, d), (c, a), (d, b), (b, c)]


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a)))


def _angle(corner: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
    u, v = one - corner, other - corner
    return float(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))


def _harmonic(faces: Int64[np.ndarray, "F 3"], rim: int, count: int) -> Float64[np.ndarray, "K L"]:
    """Weights of the rim in every new vertex, of which each is the mean of its neighbours."""
    if count == rim:
        return np.zeros((0, rim))
    order, first, _ = edge_groups(faces)
    a, b = half_edges(faces)[order[first]].T
    laplacian = np.zeros((count, count))
    laplacian[a, b] = laplacian[b, a] = -1.0
    np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
    return np.linalg.solve(laplacian[rim:, rim:], -laplacian[rim:, :rim])
