"""Weights made smooth over the surface, where the body nearby does not settle them."""

from __future__ import annotations

import itertools

import igl
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.laplacian import edge_lengths, laplacian_and_mass

_SHARP = 0.5  # of the median edge: smoothing over so little is none


def fit_smoothly(
    mesh: TriangleMesh,
    values: Float[np.ndarray, "N J"],
    width: Float[np.ndarray, " N"],
    *,
    length: float,
    laplacian: str = "auto",
) -> Float64[np.ndarray, "N J"]:
    """Smooth `values` over the surface, each as far as it is doubted.

    Minimises `tr(W' Q W) + sum_i (l^2 M_i / h_i^4) |W_i - values_i|^2` with `Q = -C + l^2 C M^-1 C`, the energy of
    robust skin weight transfer (Abdrashitov et al. 2023). C is the cotangent matrix (negative semi-definite, no unit),
    M the Voronoi mass (an area), l a length of the body, so that the minimiser does not depend on the unit. With the
    bi-Laplacian of Q a datum of width h is averaged over a neighbourhood of about h: width 0 keeps a row, an infinite
    one inpaints it, and 0 and infinity alone give the published method.

    Args:
        mesh: every vertex referenced; every component with a finite width.
        values: (N, J).
        width: (N,) h, in the mesh's unit; rows far below the edges' length are kept.
        length: l.
        laplacian: see `laplacian_and_mass`.

    Returns:
        (N, J); may leave [0, 1] a little (the energy is biharmonic).
    """
    fixed = width <= _SHARP * float(np.median(edge_lengths(mesh)))
    if fixed.all():
        return values
    # A free row's equation reaches two rings; faces further away do not matter.
    touched = np.zeros(mesh.vertex_count, dtype=bool)
    touched[mesh.faces[(~fixed)[mesh.faces].any(axis=1)]] = True
    near, used = mesh.submesh(touched[mesh.faces].any(axis=1))
    stiffness, mass = laplacian_and_mass(near, kind=laplacian)
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


def _solve_pieces(matrix: sp.csr_matrix, right: np.ndarray) -> np.ndarray:
    """The solution (n, J) of a symmetric positive definite system; the joints that a piece knows differ by piece."""
    piece = sp.csgraph.connected_components(matrix, directed=False)[1]
    order = np.argsort(piece, kind="stable")
    matrix, right = matrix[order][:, order], right[order]
    out = np.zeros_like(right)
    start = np.concatenate([[0], np.cumsum(np.bincount(piece))])
    nobody = np.zeros(0, np.int64)
    for low, high in itertools.pairwise(start):
        occurring = right[low:high].any(axis=0)
        no_values = np.zeros((0, int(occurring.sum())))
        solver = igl.min_quad_with_fixed_data()  # a sparse Cholesky, minimum degree
        block = sp.csc_matrix(matrix[low:high, low:high])
        igl.min_quad_with_fixed_precompute(block, nobody, sp.csc_matrix((0, high - low)), True, solver)
        linear = np.ascontiguousarray(-right[low:high, occurring])
        out[low:high, occurring] = igl.min_quad_with_fixed_solve(solver, linear, no_values, no_values)
    back = np.empty_like(out)
    back[order] = out
    return back


def average_neighbours(
    mesh: TriangleMesh, values: Float[np.ndarray, "N J"], rows: Bool[np.ndarray, " N"], *, steps: int
) -> Float64[np.ndarray, "N J"]:
    """Move the rows selected by a mask a fifth of the way to their neighbours' mean, `steps` times, all at once."""
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
