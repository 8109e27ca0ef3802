"""Simplify a mesh to a face budget by quadric edge collapse; borders stay, faces do not flip, vertices are traced."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import fast_simplification
import igl
import numpy as np
from jaxtyping import Int64

from smplxpp.core import GeometryWarning, MeshLike, TriangleMesh, as_mesh, require_at_least
from smplxpp.core.errors import one_line
from smplxpp.core.topology import component_labels, edge_groups, manifold_corners

# Fraction of an edge. Vertices joined by an edge below this fraction of the mean edge coincide (0.09 mm on a garment of
# 20,000 faces); doubled vertices are separated by this fraction of their distance to their neighbours.
_COINCIDENT = 1e-2
# Diagonals of the box at which the library's absolute thresholds fit, and the one that others are scaled to. Within
# them surfaces are off by the same within 3 % (body, scan and five garments at a quarter and a tenth of their faces),
# so that what is in metres stays as it is; at 100 the budget is not reached.
_FITTING, _DIAGONAL = (0.2, 5.0), 2.0
# Exponents with which the library's threshold grows from pass to pass.
_AGGRESSIVENESS = (3, 5, 7)


@dataclass(frozen=True, eq=False)
class Simplified:
    """A simplified mesh and the maps between its vertices and the source's.

    Attributes:
        mesh: n vertices, m faces.
        new_from_old: (N,) for every source vertex the vertex that it collapsed into; -1 for one without faces.
        source_vertex: (n,) for every vertex the nearest of the source vertices that collapsed into it.
        restored_faces: source faces kept as they were because simplifying there made a bad face.
        flipped_faces: faces still opposed to the nearest source face (0 unless the source folds over itself).
    """

    mesh: TriangleMesh
    new_from_old: Int64[np.ndarray, " N"]
    source_vertex: Int64[np.ndarray, " n"]
    restored_faces: int
    flipped_faces: int

    __repr__ = one_line


def simplify(mesh: MeshLike, face_budget: int) -> Simplified:
    """Collapse edges by quadric error (Garland and Heckbert 1997) down to about `face_budget` faces.

    - Border vertices stay, so that a mesh whose border alone needs more faces ends above the budget, with a warning.
    - The unit of the mesh does not matter: a small or a large one is scaled before its edges are collapsed.
    - Where the collapses make a non-manifold edge or a face opposed to the nearest source face, the source's faces are
      restored and locked, and the rest is simplified again. If locked faces of a fine source would take half of the
      budget, it is first simplified to the geometric mean of its faces and the budget.
    - Neighbouring vertices that moved to the same position merge: on a surface much finer than its features the best
      position of many vertices is the same corner.
    - Fans that meet in one vertex are cut apart, and all but the first moved back by a hundredth of their size, so that
      no two vertices share a position.

    A mesh within its budget is returned as it is.

    Args:
        mesh: manifold, possibly open (`sanitize`, `manifold_corners`).
        face_budget: number of faces.

    Raises:
        InputError: a budget below 4.

    Warns:
        GeometryWarning: more than 1.05 times the budget is left.
    """
    mesh = as_mesh(mesh, subject="mesh")
    require_at_least("face budget", face_budget, 4)
    if mesh.face_count <= face_budget:
        used = np.bincount(mesh.faces.ravel(), minlength=mesh.vertex_count) > 0
        identity = np.where(used, np.cumsum(used) - 1, -1)
        kept, source = mesh.submesh(np.ones(mesh.face_count, dtype=bool))
        return Simplified(kept, identity, source, 0, 0)
    result = _simplified(mesh, face_budget)
    if result.mesh.face_count > 1.05 * face_budget:
        warnings.warn(
            f"simplification left {result.mesh.face_count} faces where {face_budget} were asked for: borders keep "
            "their vertices, and so do folds where fewer faces would turn over",
            GeometryWarning,
            stacklevel=2,
        )
    return result


def _simplified(mesh: TriangleMesh, face_budget: int) -> Simplified:
    """Return the mesh with about `face_budget` faces, which are fewer than it has."""
    # Up to five rounds: collapse, find bad faces, and lock the source around them.
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    locked = np.zeros(mesh.face_count, dtype=bool)
    for rings in range(1, 6):
        result, new_from_old = _collapse(mesh, locked, face_budget)
        flipped = opposed_faces(result, mesh, tree)
        # Locked faces come last; the source's own faces are correct by definition, even where it folds onto itself.
        flipped[result.face_count - int(locked.sum()) :] = False
        bad = flipped | _non_manifold(result.faces)
        if not bad.any():
            break
        # Lock the source faces around the vertices that collapsed into a bad face, one ring more in each round.
        bad_vertex = np.zeros(result.vertex_count + 1, dtype=bool)
        bad_vertex[result.faces[bad]] = True
        touched = bad_vertex[new_from_old]
        for _ in range(rings):
            ring = touched[mesh.faces].any(axis=1)
            touched[mesh.faces[ring]] = True
        if (locked | ring).sum() > face_budget // 2:
            if mesh.face_count > 4 * face_budget:
                return _in_two_steps(mesh, face_budget)
            break
        locked |= ring
    # Cut fans apart, trace the vertices to the source, and separate the copies.
    faces, source_of_cut = manifold_corners(result.faces)
    result = TriangleMesh(result.vertices[source_of_cut], faces)
    source = _nearest_source(mesh, result, new_from_old, source_of_cut)
    result = separate_doubled_vertices(result, source_of_cut)
    return Simplified(result, new_from_old, source, int(locked.sum()), int(flipped.sum()))


def _in_two_steps(mesh: TriangleMesh, face_budget: int) -> Simplified:
    """Simplify to the geometric mean of the numbers of faces first, then to the budget, and join the maps."""
    fine = _simplified(mesh, round((mesh.face_count * face_budget) ** 0.5))
    if not face_budget < fine.mesh.face_count < mesh.face_count:  # its borders alone need more, or it is done
        return fine
    coarse = _simplified(fine.mesh, face_budget)
    new_from_old = np.where(fine.new_from_old >= 0, coarse.new_from_old[fine.new_from_old], -1)
    return Simplified(
        coarse.mesh,
        new_from_old,
        fine.source_vertex[coarse.source_vertex],
        coarse.restored_faces,
        coarse.flipped_faces,
    )


def _collapse(mesh: TriangleMesh, locked: np.ndarray, face_budget: int) -> tuple[TriangleMesh, np.ndarray]:
    """Simplify the faces that are not locked and append the locked ones; the border between the two stays."""
    free, used = mesh.submesh(~locked)
    budget = min(max(4, face_budget - int(locked.sum())), free.face_count)
    faces = free.faces.astype(np.int32)
    size = mesh.bbox_diagonal or 1.0
    scale = 1.0 if _FITTING[0] <= size <= _FITTING[1] else _DIAGONAL / size
    scaled, least = scale * free.vertices, free.face_count + 1
    # Low aggressiveness keeps the order of the quadrics well; more is tried only while it leaves too many faces.
    for aggressiveness in _AGGRESSIVENESS:
        points, small_faces, collapses = fast_simplification.simplify(
            scaled.copy(),
            faces.copy(),
            target_count=budget,
            agg=aggressiveness,
            preserve_border=True,
            return_collapses=True,
        )
        if len(small_faces) <= budget or len(small_faces) >= least:
            break
        least = len(small_faces)
    _, _, small_from_free = fast_simplification.replay_simplification(scaled.copy(), faces, collapses)
    points = points / scale
    points, small_faces, small_from_free = _merge_coincident(points, small_faces, small_from_free)
    # Map the source's vertices, and append vertices that only locked faces use by now.
    new_from_old = np.full(mesh.vertex_count, -1, dtype=np.int64)
    new_from_old[used] = small_from_free
    if not locked.any():
        return TriangleMesh(points, small_faces), new_from_old
    # Those are also free ones that vanished with a flap at the border of the locked faces.
    needed = np.unique(mesh.faces[locked])
    only_locked = needed[new_from_old[needed] < 0]
    new_from_old[only_locked] = len(points) + np.arange(len(only_locked))
    vertices = np.concatenate([points, mesh.vertices[only_locked]])
    return TriangleMesh(vertices, np.concatenate([small_faces, new_from_old[mesh.faces[locked]]])), new_from_old


def opposed_faces(result: TriangleMesh, source: TriangleMesh, tree: igl.AABB) -> np.ndarray:
    """Return (m,) whether each face has no area, or a normal opposed to the source face nearest to its centre."""
    _, nearest, _ = tree.squared_distance(source.vertices, source.faces, result.triangles.mean(axis=1))
    cosine = np.einsum("ij,ij->i", result.face_normals, source.face_normals[nearest])
    return (cosine < 0) | (result.face_areas <= 0)


def _merge_coincident(
    points: np.ndarray, faces: np.ndarray, point_of_free: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge vertices that an edge of no length joins, into the one of lowest index.

    Faces that lose an edge are dropped, and so are both of two faces that coincide then, a flap without volume.

    Returns:
        The points, the faces, and the map from the free vertices to the points.
    """
    edges = TriangleMesh(points, faces).edges
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    # Relative to the mean edge, so that the test does not depend on the units or the density.
    short = edges[length < _COINCIDENT * length.mean()]
    if not len(short):
        return points, faces, point_of_free
    # Each group of coincident vertices becomes its first vertex; then unused vertices are dropped.
    group = component_labels(short, len(points))
    first = np.unique(group, return_index=True)[1][np.unique(group, return_inverse=True)[1]]
    faces = first[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    # Two faces over the same three vertices bound no volume: both go.
    _, same, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    faces = faces[count[same.ravel()] == 1]
    kept = np.unique(faces)
    place = np.full(len(points), -1, dtype=np.int64)
    place[kept] = np.arange(len(kept))
    to = np.where(point_of_free >= 0, place[first[point_of_free]], -1)
    return points[kept], place[faces], to


def _non_manifold(faces: np.ndarray) -> np.ndarray:
    """Return the faces at edges with more than two faces."""
    order, _, count = edge_groups(faces)
    bad = np.zeros(len(faces), dtype=bool)
    bad[order[np.repeat(count > 2, count)] // 3] = True
    return bad


def separate_doubled_vertices(result: TriangleMesh, source_of_cut: np.ndarray) -> TriangleMesh:
    """Move copies of vertices that a cut (`manifold_corners`) doubled, but for the first, towards their one-ring."""
    doubled = np.bincount(source_of_cut)[source_of_cut] > 1
    doubled[np.unique(source_of_cut, return_index=True)[1]] = False
    if not doubled.any():
        return result
    vertices = result.vertices.copy()
    for k in np.flatnonzero(doubled):
        ring = np.setdiff1d(result.faces[(result.faces == k).any(axis=1)], [k])
        vertices[k] += _COINCIDENT * (result.vertices[ring].mean(axis=0) - vertices[k])
    return result.with_vertices(vertices)


def _nearest_source(
    mesh: TriangleMesh, result: TriangleMesh, new_from_old: np.ndarray, source_of_cut: np.ndarray
) -> np.ndarray:
    """Return the source vertex of every vertex of `result`; vertices that a cut doubled share theirs."""
    # Of the source vertices that collapsed into a vertex the nearest, then the one of lowest index.
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
