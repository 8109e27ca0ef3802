"""Smooth and inpaint weights over a surface, by the bi-Laplacian energy of robust skin weight transfer."""

from __future__ import annotations

import itertools

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64

from smplxpp.core.mesh import TriangleMesh, row_lengths

Operators = tuple[sp.csc_matrix, Float64[np.ndarray, " N"]]
"""The cotangent matrix (N, N) of a mesh and its vertices' masses (N,)."""


def fit_smoothly(
    mesh: TriangleMesh,
    values: Float[np.ndarray, "N J"],
    width: Float[np.ndarray, " N"],
    *,
    length: float,
    laplacian: str = "auto",
    whole: Operators | None = None,
) -> Float64[np.ndarray, "N J"]:
    """Smooth `values` over the surface, each over a neighbourhood of its own width.

    Minimises `tr(W' Q W) + sum_i (l^2 M_i / h_i^4) |W_i - values_i|^2` with `Q = -C + l^2 C M^-1 C`, the energy of
    robust skin weight transfer (Abdrashitov et al. 2023). C is the cotangent matrix (negative semi-definite, no unit),
    M the Voronoi mass (an area), l a length of the body, so that the minimiser does not depend on the unit. With the
    bi-Laplacian of Q a datum of width h is averaged over a neighbourhood of about h: width 0 keeps a row, an infinite
    one inpaints it, and 0 and infinity alone give the published method.

    Args:
        mesh: every vertex referenced; every component with a finite width.
        values: the data.
        width: h, in the mesh's unit; rows below half the median edge are kept, as smoothing over so little does
        nothing.
        length: l.
        laplacian: see `laplacian_and_mass`.
        whole: `shared_operators` of the mesh, where several fits have it in common.

    Returns:
        (N, J); may leave [0, 1] a little (the energy is biharmonic).
    """
    fixed = width <= 0.5 * float(np.median(edge_lengths(mesh)))
    if fixed.all():
        return values
    if whole is None:
        # A free row's equation reaches two rings; faces further away do not matter.
        touched = np.zeros(mesh.vertex_count, dtype=bool)
        touched[mesh.faces[(~fixed)[mesh.faces].any(axis=1)]] = True
        near, used = mesh.submesh(touched[mesh.faces].any(axis=1))
        stiffness, mass = laplacian_and_mass(near, kind=laplacian)
    else:
        (stiffness, mass), used = whole, np.arange(mesh.vertex_count)
    # Set up the normal equations of the free rows, divided by l^2; fixed rows go to the right-hand side.
    free = ~fixed[used]
    data = np.zeros(len(used))
    data[free] = mass[free] / width[used[free]] ** 4
    rows = stiffness.tocsr()[free]
    energy = (rows @ sp.diags(1.0 / mass) @ stiffness - rows / length**2).tocsc()
    right = data[free, None] * values[used[free]] - energy[:, ~free] @ values[used[~free]]
    matrix = (energy[:, free] + sp.diags(data[free])).tocsr()
    out = np.array(values, dtype=np.float64)
    out[used[free]] = _solve_pieces(matrix, right)
    return out


def shared_operators(mesh: TriangleMesh, laplacian: str) -> Operators | None:
    """Return the Laplacian and masses that every part of a mesh has in common with it.

    None where a face is so thin that it changes those of its neighbours: each part is then better off on its own.
    """
    lengths = edge_lengths(mesh)
    if laplacian == "intrinsic" or _has_slivers(lengths) or (mollify(lengths) != lengths).any():
        return None
    return laplacian_and_mass(mesh, kind="cotangent")


def _solve_pieces(matrix: sp.csr_matrix, right: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive definite system (n, J) piece by piece, each for the joints that occur in it."""
    # Sort the rows by connected component of the matrix, which makes it block diagonal; small pieces are solved
    # together, up to so few rows that a factorisation takes about the time of its call.
    shared_rows = 500
    count, piece = sp.csgraph.connected_components(matrix, directed=False)
    order = np.argsort(piece, kind="stable")
    if count > 1:
        matrix, right = matrix[order][:, order], right[order]
    out = np.zeros_like(right)
    ends = np.cumsum(np.bincount(piece))
    start = np.concatenate([[0], ends[np.append(np.diff(ends // shared_rows) > 0, True)]])
    no_rows = np.zeros(0, np.int64)
    # Solve each block by a sparse Cholesky factorisation in minimum-degree order.
    for low, high in itertools.pairwise(start):
        occurring = right[low:high].any(axis=0)
        no_values = np.zeros((0, int(occurring.sum())))
        solver = igl.min_quad_with_fixed_data()
        block = sp.csc_matrix(matrix if high - low == len(right) else matrix[low:high, low:high])
        igl.min_quad_with_fixed_precompute(block, no_rows, sp.csc_matrix((0, high - low)), True, solver)
        linear = np.ascontiguousarray(-right[low:high, occurring])
        out[low:high, occurring] = igl.min_quad_with_fixed_solve(solver, linear, no_values, no_values)
    back = np.empty_like(out)
    back[order] = out
    return back


def average_neighbours(
    mesh: TriangleMesh, values: Float[np.ndarray, "N J"], rows: Bool[np.ndarray, " N"], *, steps: int
) -> Float64[np.ndarray, "N J"]:
    """Move masked rows 20 % towards the mean of their neighbours, `steps` times, all rows at once."""
    n, e = mesh.vertex_count, mesh.edges
    adjacency = sp.coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), shape=(n, n)).tocsr()
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    rows = np.flatnonzero(rows & (degree > 0))
    mean = sp.diags(1.0 / degree[rows]) @ adjacency[rows]
    out = values.copy()
    for _ in range(steps):
        out[rows] = 0.8 * out[rows] + 0.2 * (mean @ out)
    return out


def edge_lengths(mesh: TriangleMesh) -> Float64[np.ndarray, "M 3"]:
    """Return the lengths of the edges opposite to each corner."""
    t = mesh.triangles
    return np.stack([row_lengths(t[:, (k + 1) % 3] - t[:, (k + 2) % 3]) for k in range(3)], axis=1)


def mollify(lengths: Float[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3"]:
    """Lengthen all edges by the least constant that makes every face a proper triangle.

    `l_a + l_b - l_c >= 1e-4 * mean` afterwards (Sharp and Crane, "A Laplacian for Nonmanifold Triangle Meshes", 2020,
    section 4.5); unchanged where all faces are proper already.
    """
    shortfall = 1e-4 * lengths.mean() - (lengths.sum(axis=1, keepdims=True) - 2.0 * lengths)
    return lengths + max(0.0, float(shortfall.max(initial=0.0)))


def laplacian_and_mass(mesh: TriangleMesh, *, kind: str = "auto") -> Operators:
    """Return the cotangent matrix C (N, N), negative semi-definite, and Voronoi masses (N,), all positive.

    Args:
        mesh: every vertex referenced by a face.
        kind: "cotangent": as the mesh is (zero-area faces are still mollified: their cotangents do not exist).
            "intrinsic": edges flipped to an intrinsic Delaunay triangulation (Bobenko and Springborn 2007), which has
            no negative weights; needs at most two faces at an edge, wound alike. "auto": "intrinsic"
            where some angle is below 0.1 degrees, else "cotangent".
    """
    lengths = edge_lengths(mesh)
    if kind == "auto":
        kind = "intrinsic" if _has_slivers(lengths) else "cotangent"
    lengths, faces = mollify(lengths), mesh.faces
    if kind == "intrinsic" and igl.is_edge_manifold(faces)[0]:
        lengths, faces = igl.intrinsic_delaunay_triangulation(lengths, faces)[:2]
    cotangent = igl.cotmatrix_intrinsic(lengths, faces)
    mass = igl.massmatrix_intrinsic(lengths, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    return sp.csc_matrix(cotangent), mass


def _has_slivers(lengths: np.ndarray) -> bool:
    """Return whether some angle of a face is below 0.1 degrees, as where it has no area."""
    a, b, c = np.sort(lengths, axis=1).T  # the smallest angle lies opposite to a
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.where(b * c > 0, (b * b + c * c - a * a) / (2 * b * c), 1.0)
    return bool(np.arccos(np.clip(cosine, -1.0, 1.0)).min(initial=np.pi / 3) < np.radians(0.1))
