"""Weights where nothing was matched: the smoothest continuation of those that were."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.laplacian import edge_lengths, laplacian_and_mass

_SHARP = 0.25  # of the median edge: (1/4)^4 of smoothing is none


def inpainting_energy(mesh: TriangleMesh, *, length: float, laplacian: str = "auto") -> sp.csc_matrix:
    """The quadratic form `Q = -C + l^2 C M^-1 C` of robust skin weight transfer (Abdrashitov et al. 2023).

    C is the cotangent matrix (negative semi-definite, no unit), M the Voronoi mass (an area), `length` = l in the
    mesh's unit: with a length of the body's own the minimiser does not depend on the unit.

    Returns:
        (N, N) symmetric, positive semi-definite; its null space on a component is the constants.
    """
    stiffness, mass = laplacian_and_mass(mesh, kind=laplacian)
    return sp.csc_matrix(-stiffness + length**2 * (stiffness @ sp.diags(1.0 / mass) @ stiffness))


def inpaint(
    mesh: TriangleMesh, values: np.ndarray, known: np.ndarray, *, length: float, laplacian: str = "auto"
) -> np.ndarray:
    """Minimise `tr(W' Q W)` with the rows `known` fixed to `values`.

    Args:
        mesh: every vertex referenced; every component with a known vertex.
        values: (N, J); only the rows `known` are read.
        known: (N,) bool.

    Returns:
        (N, J); may leave [0, 1] a little between the known rows (the energy is biharmonic).
    """
    if known.all():
        return values
    energy = inpainting_energy(mesh, length=length, laplacian=laplacian)
    return _solve(energy, np.zeros_like(values), values, known)


def fit_smoothly(
    mesh: TriangleMesh, values: np.ndarray, width: np.ndarray, *, length: float, laplacian: str = "auto"
) -> np.ndarray:
    """Smooth `values` over the surface, each as far as it is doubted.

    Minimises `tr(W' Q W) + sum_i (l^2 M_i / h_i^4) |W_i - values_i|^2`: with the bi-Laplacian of Q, a datum of width h
    is averaged over a neighbourhood of about h. Rows whose width is far below the edges' length are fixed.

    Args:
        values: (N, J). width: (N,) h, in the mesh's unit; 0 keeps the row.
    """
    fixed = width <= _SHARP * float(np.median(edge_lengths(mesh)))
    if fixed.all():
        return values
    stiffness, mass = laplacian_and_mass(mesh, kind=laplacian)
    data = mass / np.where(fixed, 1.0, width) ** 4
    data[fixed] = 0.0
    energy = sp.csc_matrix(stiffness @ sp.diags(1.0 / mass) @ stiffness - stiffness / length**2 + sp.diags(data))
    return _solve(energy, data[:, None] * values, values, fixed)


def average_neighbours(mesh: TriangleMesh, values: np.ndarray, rows: np.ndarray, *, steps: int) -> np.ndarray:
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


def _solve(energy: sp.csc_matrix, linear: np.ndarray, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Minimise `tr(W' Q W) - 2 tr(W' B)` with the rows `known` fixed; one factorisation serves all columns."""
    free = np.flatnonzero(~known)
    rows = energy.tocsr()[free].tocsc()
    right = linear[free] - rows[:, known] @ values[known]
    # Minimum degree on the symmetric pattern, pivots on the diagonal: SuperLU as a sparse Cholesky.
    factor = spl.splu(rows[:, free], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    out = np.array(values, dtype=np.float64)
    out[free] = factor.solve(right)
    return out
