"""Simplification to a face budget: borders kept, manifold, no face turned over, every vertex traced to the source."""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import igl
import numpy as np
from jaxtyping import Int64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import component_labels, edge_groups, manifold_corners
from smplxpp.core.validation import require_at_least

# Collapses per pass: 3 keeps the quadric order well; higher is no faster at these sizes and breaks manifoldness.
_AGGRESSIVENESS = 3
_MAX_ROUNDS = 5
# Edges below this share of the mean edge join vertices that went to one place (0.09 mm on a garment of 20,000 faces).
_SAME_PLACE = 1e-2
# A source of more than this many times the budget may be simplified half-way first.
_FINE = 4


@dataclass(frozen=True, eq=False)
class Simplified:
    """A simplified mesh and its maps.

    Attributes:
        mesh: n vertices, m faces.
        new_from_old: (N,) for every source vertex the vertex that it collapsed into; -1 for one without faces.
        source_vertex: (n,) the source vertex, among those that collapsed into each, that lies nearest to it.
        restored_faces: source faces kept as they were because simplifying there made a bad face.
        flipped_faces: faces still opposed to the nearest source face (0 unless the source folds over itself).
    """

    mesh: TriangleMesh
    new_from_old: Int64[np.ndarray, " N"]
    source_vertex: Int64[np.ndarray, " n"]
    restored_faces: int
    flipped_faces: int


def simplify(mesh: TriangleMesh, face_budget: int) -> Simplified:
    """Collapse edges by quadric error (Garland and Heckbert 1997) down to about `face_budget` faces.

    Border vertices stay, so a mesh whose border alone needs more faces ends above the budget. Where the collapses make
    a non-manifold edge or a face opposed to the nearest source face, the source's faces are restored and locked, and
    the rest is simplified again; where those of a fine source would take half of the budget, it is simplified half-way
    first (to the geometric mean of its faces and the budget). Vertices that an edge joins and that went to the same
    place become one: on a surface much finer than its features the best place of many is the same corner. Where fans
    meet in one vertex alone they are cut apart, and all but the first drawn back by a hundredth of their size: no two
    vertices share a place. A mesh within its budget returns as it is.

    Args:
        mesh: manifold, possibly open (`sanitize`, `manifold_corners`).

    Raises:
        InputError: a budget below 4.
    """
    require_at_least("face budget", face_budget, 4)
    if mesh.face_count <= face_budget:
        used = np.bincount(mesh.faces.ravel(), minlength=mesh.vertex_count) > 0
        identity = np.where(used, np.cumsum(used) - 1, -1)
        kept, source = mesh.submesh(np.ones(mesh.face_count, dtype=bool))
        return Simplified(kept, identity, source, 0, 0)
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    locked = np.zeros(mesh.face_count, dtype=bool)
    for rings in range(1, _MAX_ROUNDS + 1):
        result, new_from_old = _collapse(mesh, locked, face_budget)
        flipped = opposed(result, mesh, tree)
        # Locked faces come last; the source's own faces are right by definition, even where it folds onto itself.
        flipped[result.face_count - int(locked.sum()) :] = False
        bad = flipped | _non_manifold(result.faces)
        if not bad.any():
            break
        # Lock the source faces about the vertices that went into a bad face, a ring more each round.
        bad_vertex = np.zeros(result.vertex_count + 1, dtype=bool)
        bad_vertex[result.faces[bad]] = True
        touched = bad_vertex[new_from_old]
        for _ in range(rings):
            ring = touched[mesh.faces].any(axis=1)
            touched[mesh.faces[ring]] = True
        if (locked | ring).sum() > face_budget // 2:
            if mesh.face_count > _FINE * face_budget:
                return _in_two_steps(mesh, face_budget)
            break
        locked |= ring
    faces, source_of_cut = manifold_corners(result.faces)
    result = TriangleMesh(result.vertices[source_of_cut], faces)
    source = _nearest_source(mesh, result, new_from_old, source_of_cut)
    result = drawn_apart(result, source_of_cut)
    return Simplified(result, new_from_old, source, int(locked.sum()), int(flipped.sum()))


def _in_two_steps(mesh: TriangleMesh, face_budget: int) -> Simplified:
    """The simplification of the mesh simplified half-way, mapped to the mesh's own vertices."""
    fine = simplify(mesh, round((mesh.face_count * face_budget) ** 0.5))
    if fine.mesh.face_count >= mesh.face_count:  # its borders alone need more
        return fine
    coarse = simplify(fine.mesh, face_budget)
    new_from_old = np.where(fine.new_from_old >= 0, coarse.new_from_old[fine.new_from_old], -1)
    return Simplified(
        coarse.mesh,
        new_from_old,
        fine.source_vertex[coarse.source_vertex],
        coarse.restored_faces,
        coarse.flipped_faces,
    )


def _collapse(mesh: TriangleMesh, locked: np.ndarray, face_budget: int) -> tuple[TriangleMesh, np.ndarray]:
    """Simplify the faces that are not locked and put the locked ones back: the border between the two stays."""
    free, used = mesh.submesh(~locked)
    budget = max(4, face_budget - int(locked.sum()))
    faces = free.faces.astype(np.int32)
    points, small_faces, collapses = fast_simplification.simplify(
        free.vertices.copy(),
        faces.copy(),
        target_count=min(budget, free.face_count),
        agg=_AGGRESSIVENESS,
        preserve_border=True,
        return_collapses=True,
    )
    _, _, small_from_free = fast_simplification.replay_simplification(free.vertices.copy(), faces, collapses)
    points, small_faces, small_from_free = _joined(points, small_faces, small_from_free)
    new_from_old = np.full(mesh.vertex_count, -1, dtype=np.int64)
    new_from_old[used] = small_from_free
    if not locked.any():
        return TriangleMesh(points, small_faces), new_from_old
    only_locked = np.setdiff1d(mesh.faces[locked], used)
    new_from_old[only_locked] = len(points) + np.arange(len(only_locked))
    vertices = np.concatenate([points, mesh.vertices[only_locked]])
    return TriangleMesh(vertices, np.concatenate([small_faces, new_from_old[mesh.faces[locked]]])), new_from_old


def opposed(result: TriangleMesh, source: TriangleMesh, tree: igl.AABB) -> np.ndarray:
    """(m,) the faces whose normal opposes the source face nearest to their middle, or that have no area."""
    _, nearest, _ = tree.squared_distance(source.vertices, source.faces, result.triangles.mean(axis=1))
    cosine = np.einsum("ij,ij->i", result.face_normals, source.face_normals[nearest])
    return (cosine < 0) | (result.face_areas <= 0)


def _joined(
    points: np.ndarray, faces: np.ndarray, point_of_free: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The collapsed mesh with vertices made one that an edge without length joins: points, faces, the map to them.

    The vertex of lowest index stays. Faces that lose an edge go, and so do both of two faces that come to lie on each
    other: a flap without a volume.
    """
    edges = TriangleMesh(points, faces).edges
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    short = edges[length < _SAME_PLACE * length.mean()]
    if not len(short):
        return points, faces, point_of_free
    group = component_labels(short, len(points))
    first = np.unique(group, return_index=True)[1][np.unique(group, return_inverse=True)[1]]
    faces = first[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, same, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    faces = faces[count[same.ravel()] == 1]
    kept = np.unique(faces)
    place = np.full(len(points), -1, dtype=np.int64)
    place[kept] = np.arange(len(kept))
    to = np.where(point_of_free >= 0, place[first[point_of_free]], -1)
    return points[kept], place[faces], to


def _non_manifold(faces: np.ndarray) -> np.ndarray:
    """The faces at an edge with more than two faces."""
    order, _, count = edge_groups(faces)
    bad = np.zeros(len(faces), dtype=bool)
    bad[order[np.repeat(count > 2, count)] // 3] = True
    return bad


def drawn_apart(result: TriangleMesh, source_of_cut: np.ndarray) -> TriangleMesh:
    """The mesh with vertices that a cut (`manifold_corners`) doubled moved towards the middle of their own fans."""
    doubled = np.bincount(source_of_cut)[source_of_cut] > 1
    doubled[np.unique(source_of_cut, return_index=True)[1]] = False
    if not doubled.any():
        return result
    vertices = result.vertices.copy()
    for k in np.flatnonzero(doubled):
        ring = np.setdiff1d(result.faces[(result.faces == k).any(axis=1)], [k])
        vertices[k] += _SAME_PLACE * (result.vertices[ring].mean(axis=0) - vertices[k])
    return result.with_vertices(vertices)


def _nearest_source(
    mesh: TriangleMesh, result: TriangleMesh, new_from_old: np.ndarray, source_of_cut: np.ndarray
) -> np.ndarray:
    """The source vertex of every vertex of `result`; vertices that a cut doubled share theirs."""
    old = np.flatnonzero(new_from_old >= 0)
    new = new_from_old[old]
    position = np.empty((int(source_of_cut.max()) + 1, 3))
    position[source_of_cut] = result.vertices
    distance = np.linalg.norm(mesh.vertices[old] - position[np.minimum(new, len(position) - 1)], axis=1)
    order = np.lexsort((old, distance, new))
    first = np.unique(new[order], return_index=True)[1]
    nearest = np.full(int(new.max()) + 1, -1, dtype=np.int64)
    nearest[new[order][first]] = old[order][first]
    return nearest[source_of_cut]
