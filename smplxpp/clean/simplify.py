"""Simplification to a face budget: borders kept, manifold, no face turned over, every vertex traced to the source."""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import igl
import numpy as np
from jaxtyping import Int64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import edge_groups, manifold_corners
from smplxpp.core.validation import require_at_least

# Collapses per pass: 3 keeps the quadric order well; higher is no faster at these sizes and breaks manifoldness.
_AGGRESSIVENESS = 3
_MAX_ROUNDS = 5


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
    the rest is simplified again. A mesh within its budget returns as it is.

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
        flipped = _opposed(result, mesh, tree)
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
            break
        locked |= ring
    faces, source_of_cut = manifold_corners(result.faces)
    result = TriangleMesh(result.vertices[source_of_cut], faces)
    source = _nearest_source(mesh, result, new_from_old, source_of_cut)
    return Simplified(result, new_from_old, source, int(locked.sum()), int(flipped.sum()))


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
    new_from_old = np.full(mesh.vertex_count, -1, dtype=np.int64)
    new_from_old[used] = small_from_free
    if not locked.any():
        return TriangleMesh(points, small_faces), new_from_old
    only_locked = np.setdiff1d(mesh.faces[locked], used)
    new_from_old[only_locked] = len(points) + np.arange(len(only_locked))
    vertices = np.concatenate([points, mesh.vertices[only_locked]])
    return TriangleMesh(vertices, np.concatenate([small_faces, new_from_old[mesh.faces[locked]]])), new_from_old


def _opposed(result: TriangleMesh, source: TriangleMesh, tree: igl.AABB) -> np.ndarray:
    """The faces whose normal opposes the source face nearest to their middle, or that have no area."""
    _, nearest, _ = tree.squared_distance(source.vertices, source.faces, result.triangles.mean(axis=1))
    cosine = np.einsum("ij,ij->i", result.face_normals, source.face_normals[nearest])
    return (cosine < 0) | (result.face_areas <= 0)


def _non_manifold(faces: np.ndarray) -> np.ndarray:
    """The faces at an edge with more than two faces."""
    order, _, count = edge_groups(faces)
    bad = np.zeros(len(faces), dtype=bool)
    bad[order[np.repeat(count > 2, count)] // 3] = True
    return bad


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
