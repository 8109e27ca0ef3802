"""Vertices of a coarse mesh moved to where its faces, not its corners, lie nearest to the surface they stand for."""

from __future__ import annotations

import igl
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from smplxpp.core.mesh import TriangleMesh

_ROUNDS = 2
# What holds a vertex beside the source's points on its faces, as shares of what they weigh on average: its way must be
# like its neighbours', and a little that it be short.
_SMOOTH, _SHORT = 0.05, 0.005
# A face that turns by more than its cosine says takes its vertices back.
_TURNED = 0.5


def settled(mesh: TriangleMesh, source: TriangleMesh) -> TriangleMesh:
    """The mesh with vertices moved so that the source's points lie nearest to its faces, in the mean of squares.

    Corners that lie on a rounded surface have faces that cut through it: half of the way between the two is given back.
    Weighted least squares, twice: min over x of sum_k a_k |p_k - B_k x|^2 + s |L (x - x0)|^2 + t |x - x0|^2, where p_k
    is a vertex of the source, a_k its share of the area, B_k the barycentric coordinates of the place on the mesh that
    lies nearest to it and L the uniform Laplacian. Vertices on borders stay, and so do those whose faces would turn by
    more than 60 degrees.

    Args:
        mesh: every vertex used. source: what it stands for, in the same place.
    """
    area = np.bincount(source.faces.ravel(), np.repeat(source.face_areas / 3.0, 3), minlength=source.vertex_count)
    points, area = source.vertices[area > 0], area[area > 0]
    free = np.ones(mesh.vertex_count, dtype=bool)
    free[mesh.border_edges] = False
    for _ in range(_ROUNDS):
        moves = _moves(mesh, points, area, free)
        while True:
            made = mesh.with_vertices(mesh.vertices + moves)
            turned = np.einsum("ij,ij->i", made.face_normals, mesh.face_normals) < _TURNED
            back = np.unique(mesh.faces[turned])
            if not moves[back].any():
                break
            moves[back] = 0.0
        mesh = made
    return mesh


def _moves(mesh: TriangleMesh, points: np.ndarray, area: np.ndarray, free: np.ndarray) -> np.ndarray:
    """(n, 3) the ways of all vertices, zero where they are not free."""
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    _, face, nearest = tree.squared_distance(mesh.vertices, mesh.faces, points)
    corners, count = mesh.faces[face], mesh.vertex_count
    weights = igl.barycentric_coordinates(nearest, *(mesh.vertices[corners[:, k]] for k in range(3)))
    rows = np.repeat(np.arange(len(points)), 3)
    blend = sparse.csr_matrix((weights.ravel(), (rows, corners.ravel())), (len(points), count))
    edges = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    neighbours = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    degree = np.maximum(np.asarray(neighbours.sum(axis=1)).ravel(), 1.0)
    laplacian = sparse.identity(count) - sparse.diags(1.0 / degree) @ neighbours
    share = area.sum() / count
    system = (
        blend.T @ sparse.diags(area) @ blend
        + _SMOOTH * share * (laplacian.T @ laplacian)
        + _SHORT * share * sparse.identity(count)
    ).tocsr()
    aim = blend.T @ (area[:, None] * (points - blend @ mesh.vertices))
    moves = np.zeros((count, 3))
    if free.any():
        moves[free] = splu(system[free][:, free].tocsc()).solve(aim[free])
    return moves
