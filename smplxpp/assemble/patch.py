"""Close a hole by the patch of least area, refined to the density of the mesh around it (Liepa 2003), and drape it.

A patch of least area goes straight from rim to rim; under a sleeve whose lower side was fused with the trunk it would
go through the arm. `drape_patches` moves its new vertices x round a limb, to the distance from the skin that their rims
have, in three steps:

    1. bend    x minimises |L x|^2 (L: the uniform Laplacian), so that the patch continues in the direction of its rim
    2. blow    vertices that are still in the body move out along the normal of the patch, and the others follow by 1
    3. settle  x falls to a membrane (Jacobi steps), but keeps signed distance(x) >= s from the body

s is the harmonic function of the distances of the rim, so that a wide sleeve stays wide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64
from scipy.sparse import diags, identity
from scipy.sparse.linalg import spsolve

from smplxpp.assemble.build import CanonicalPart
from smplxpp.core import InputError, TriangleMesh, row_lengths
from smplxpp.core.mesh import cross_rows
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import edge_groups, half_edges, mean_of_neighbours

MAX_LOOP = 400
"""Largest number of vertices of a border; time grows with their cube."""
STAND_OFF = (0.003, 0.04)
"""Bounds of the distance that a patch keeps from the skin, metres: cloth lies 2 to 5 mm off; the 4 cm of a wide sleeve
are not taken farther out."""
_BLOW, _BLOW_STEP, _BLOW_PULL = 2, 0.02, 0.1
"""Steps of blowing up; the move that is asked of a vertex in the body, metres, less than a limb's radius; its weight
beside the patch's bending. Two steps clear a sleeve of which a third is left; more crumple a coarse patch."""
_SETTLE = 20
"""Steps of settling. Uniform weights let vertices drift along a limb, so that more of them fold a patch at its rim."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A triangulation that closes a border loop of L vertices.

    Attributes:
        faces: (F, 3), wound as the mesh around; 0 to L - 1 are the loop's vertices in order, K new ones follow.
        from_rim: (K, L) float64 coefficients of the new vertices' positions, colours or weights in those of the loop;
            rows sum to 1. Each new vertex is the mean of its neighbours (discrete harmonic), so that no value leaves
            the range of the rim's.
    """

    faces: Int64[np.ndarray, "F 3"]
    from_rim: Float64[np.ndarray, "K L"]

    def places(self, rim: Float[np.ndarray, "L 3"]) -> Float64[np.ndarray, "N 3"]:
        """Return the positions of the loop's vertices, then of the new ones."""
        return np.concatenate([rim, self.from_rim @ rim])

    def area(self, rim: Float[np.ndarray, "L 3"]) -> float:
        """Return the area of the patch, square metres."""
        return float(TriangleMesh(self.places(rim), self.faces).face_areas.sum())

    def width(self, rim: Float[np.ndarray, "L 3"]) -> float:
        """Return twice the area divided by the perimeter, metres: a long slit's mean width, or a disc's radius."""
        return 2.0 * self.area(rim) / float(row_lengths(np.roll(rim, -1, axis=0) - rim).sum())


def patch_loop(mesh: TriangleMesh, loop: Int[np.ndarray, " L"]) -> Patch:
    """Close a border loop of a manifold mesh (`smplxpp.core.topology.border_loops`).

    The loop is triangulated with the least area (Barequet and Sharir 1995). Triangles larger than the rim's edges are
    split and edges flipped until they are Delaunay (Liepa, *Filling holes in meshes*, SGP 2003). New vertices are
    placed at the mean of their neighbours. Two vertices of the loop that share an edge outside get none inside.

    Raises:
        InputError: fewer than 3 or more than `MAX_LOOP` vertices, or a loop that only an existing edge could close.
    """
    count = len(loop)
    if not 3 <= count <= MAX_LOOP:
        raise InputError("hole", expected=f"a border of 3 to {MAX_LOOP} vertices", received=str(count))
    # 1. Triangulate with the least area, without edges that exist already.
    rim = mesh.vertices[loop]
    taken = _chords(mesh.faces, loop)
    faces = _least_area(rim, taken)
    # 2. Refine to the edge lengths at the rim, but to no more than about 1000 new vertices, which bounds a border of
    # many tiny edges.
    around = row_lengths(np.roll(rim, -1, axis=0) - rim)
    least = (sum(_area(*rim[list(face)]) for face in faces) / 1000) ** 0.5
    spacing = list(np.maximum(0.5 * (around + np.roll(around, 1)), least))
    places = list(rim)
    for _ in range(12):
        if not _split(faces, places, spacing):
            break
        _flip_to_delaunay(faces, np.array(places), taken)
    # 3. Harmonic coefficients of the new vertices.
    triangles = np.array(faces, dtype=np.int64)
    return Patch(triangles, _harmonic(triangles, count, len(places)))


def _chords(faces: Int[np.ndarray, "M 3"], loop: Int[np.ndarray, " L"]) -> set[tuple[int, int]]:
    """Return the pairs of positions in the loop, lower first, between which the mesh has an edge."""
    at = np.full(int(max(faces.max(), loop.max())) + 1, -1)
    at[loop] = np.arange(len(loop))
    # Edges with both ends in the loop; -1 marks vertices outside of it.
    ends = np.sort(at[half_edges(faces)], axis=1)
    return {(int(a), int(b)) for a, b in ends[ends[:, 0] >= 0]}


def _least_area(rim: Float[np.ndarray, "L 3"], taken: set[tuple[int, int]]) -> list[tuple[int, int, int]]:
    """Return the triangulation of a loop with the least area, by dynamic programming over its diagonals.

    cost[i, j] is the least area over the vertices i to j: min over k of cost[i, k] + cost[k, j] + area(i, k, j).
    """
    count = len(rim)
    cost, middle = np.full((count, count), np.inf), np.zeros((count, count), dtype=np.int64)
    cost[np.arange(count - 1), np.arange(1, count)] = 0.0
    # From short chains of the border to long ones, so that both parts of a split are known. Diagonals that are edges of
    # the mesh already would get a third face.
    for gap in range(2, count):
        for i in range(count - gap):
            j = i + gap
            if (i, j) in taken and gap != count - 1:
                continue
            k = np.arange(i + 1, j)
            area = 0.5 * row_lengths(cross_rows(rim[k] - rim[i], rim[j] - rim[i]))
            total = cost[i, k] + cost[k, j] + area
            best = int(np.argmin(total))
            cost[i, j], middle[i, j] = total[best], k[best]
    if not np.isfinite(cost[0, count - 1]):
        raise InputError("hole", expected="a border that faces can close", received="one with edges across it")
    # Trace the best diagonals back; faces run against the border's direction.
    faces: list[tuple[int, int, int]] = []
    sides = [(0, count - 1)]
    while sides:
        low, high = sides.pop()
        if high - low >= 2:
            between = int(middle[low, high])
            faces.append((high, between, low))
            sides += [(low, between), (between, high)]
    return faces


def _split(faces: list[tuple[int, int, int]], places: list[np.ndarray], spacing: list[float]) -> bool:
    """Insert a vertex at the centroid of each face that is larger than the edges around; return whether there was one.

    Liepa's criterion: sqrt(2) times the distance from centroid to every corner exceeds the spacing at both.
    """
    before = len(faces)
    for index in range(before):
        corners = faces[index]
        middle = np.mean([places[c] for c in corners], axis=0)
        wanted = float(np.mean([spacing[c] for c in corners]))
        reach = [2.0**0.5 * float(np.linalg.norm(middle - places[c])) for c in corners]
        if any(r <= max(wanted, spacing[c]) for r, c in zip(reach, corners, strict=True)):
            continue
        new = len(places)
        places.append(middle)
        spacing.append(wanted)
        a, b, c = corners
        faces[index] = (a, b, new)
        faces += [(b, c, new), (c, a, new)]
    return len(faces) > before


def _flip_to_delaunay(
    faces: list[tuple[int, int, int]], places: Float[np.ndarray, "N 3"], taken: set[tuple[int, int]]
) -> None:
    """Flip inner edges with opposite angles that sum to more than pi, until there is none."""
    # The face of each directed edge; a queue of inner edges; a budget, because flips may cycle on a curved patch.
    beside: dict[tuple[int, int], int] = {}
    for index, face in enumerate(faces):
        beside.update({(face[k], face[(k + 1) % 3]): index for k in range(3)})
    todo = [edge for edge in beside if edge[0] < edge[1] and edge[::-1] in beside]
    budget = 20 * len(faces)
    while todo and budget:
        budget -= 1
        a, b = todo.pop()
        # Skip edges that are gone, whose other diagonal exists, or that are Delaunay already.
        if (a, b) not in beside or (b, a) not in beside:
            continue
        first, second = beside[a, b], beside[b, a]
        (c,), (d,) = set(faces[first]) - {a, b}, set(faces[second]) - {a, b}
        low, high = min(c, d), max(c, d)
        if (low, high) in taken or (c, d) in beside or (d, c) in beside:
            continue
        if _angle(places[c], places[a], places[b]) + _angle(places[d], places[a], places[b]) <= np.pi + 1e-9:
            continue
        # Replace the faces (a, b, c) and (b, a, d) by those of the other diagonal, and check their outer edges again.
        del beside[a, b], beside[b, a]
        faces[first], faces[second] = (a, d, c), (d, b, c)
        beside.update({(a, d): first, (d, c): first, (c, a): first, (d, b): second, (b, c): second, (c, d): second})
        todo += [(a, d), (c, a), (d, b), (b, c)]


def _area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a)))


def _angle(corner: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
    u, v = one - corner, other - corner
    # The cross product of two single vectors by hand, because numpy's takes twenty times as long for them.
    (a, b, c), (d, e, f) = u.tolist(), v.tolist()
    return float(np.arctan2(np.linalg.norm(np.array([b * f - c * e, c * d - a * f, a * e - b * d])), u @ v))


def _harmonic(faces: Int64[np.ndarray, "F 3"], rim: int, count: int) -> Float64[np.ndarray, "K L"]:
    """Return the coefficients of the rim in every new vertex, each of which is the mean of its neighbours."""
    if count == rim:
        return np.zeros((0, rim))
    # Solve the graph Laplacian's equations of the new vertices for the unit values of each rim vertex.
    order, first, _ = edge_groups(faces)
    a, b = half_edges(faces)[order[first]].T
    laplacian = np.zeros((count, count))
    laplacian[a, b] = laplacian[b, a] = -1.0
    np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
    return np.linalg.solve(laplacian[rim:, rim:], -laplacian[rim:, :rim])


def drape_patches(part: CanonicalPart, new: Bool[np.ndarray, " N"], body: TriangleMesh) -> CanonicalPart:
    """Move the new vertices of patches out of the body, and to the distance from it that their rims have.

    Vertices inside of the body move along the patch's normal, which points out of the person, until they are outside.
    The gradient of the distance would lead half of them to the far side of the limb.

    Args:
        part: in the T-pose, with patches.
        new: its vertices that patches have added; the others stay.
        body: at rest, closed.
    """
    if not new.any():
        return part
    field, free = SignedDistanceField(body, solid=True), np.flatnonzero(new)
    mean = mean_of_neighbours(part.mesh.edges, part.mesh.border_edges, part.mesh.vertex_count)
    # The stand-off is harmonic between the rim's distances.
    wanted = np.zeros(part.mesh.vertex_count)
    rim = np.unique(part.mesh.faces[new[part.mesh.faces].any(axis=1)])
    rim = rim[~new[rim]]
    wanted[rim] = np.clip(field.query(part.mesh.vertices[rim]).distance, *STAND_OFF)
    laplacian = (identity(len(wanted)) - mean).tocsr()[free]
    off = spsolve(laplacian[:, free].tocsc(), -laplacian[:, rim] @ wanted[rim])
    # The surface that continues as its rim does has the least squared Laplacian over new and rim vertices: it bends
    # round a limb where a membrane goes across.
    x, rows = part.mesh.vertices.copy(), (identity(len(wanted)) - mean).tocsr()[np.concatenate([free, rim])]
    bent, known = rows[:, free], rows @ np.where(new[:, None], 0.0, x)
    x[free] = spsolve((bent.T @ bent).tocsc(), -(bent.T @ known))
    # Vertices that are too near are drawn out, and the others follow.
    for _ in range(_BLOW):
        found = field.query(x[free])
        near = found.distance < 0.5 * off
        if not near.any():
            break
        normal = part.mesh.with_vertices(x).vertex_normals[free]
        outward = np.einsum("ij,ij->i", found.gradient, normal) > 0.3
        moved = x[free] + (off - found.distance)[:, None] * found.gradient
        moved = np.where(outward[:, None], moved, x[free] + _BLOW_STEP * normal)
        drawn = _BLOW_PULL * diags(near.astype(float))
        x[free] = spsolve((bent.T @ bent + drawn).tocsc(), drawn @ moved - bent.T @ known)
    # Then let it fall to the membrane; what comes too near returns along the gradient, which points outwards now.
    for _ in range(_SETTLE):
        x[free] = mean[free] @ x
        found = field.query(x[free])
        near = found.distance < off
        x[free[near]] += ((off - found.distance)[:, None] * found.gradient)[near]
    return replace(part, mesh=part.mesh.with_vertices(x))
