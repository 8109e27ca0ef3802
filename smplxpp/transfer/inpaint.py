"""Weights where nothing was matched: the smoothest continuation of those that were."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.laplacian import laplacian_and_mass


def inpainting_energy(mesh: TriangleMesh, *, length: float, laplacian: str = "auto") -> sp.csc_matrix:
    """The quadratic form `Q = -C + l^2 C M^-1 C` of robust skin weight transfer (Abdrashitov et al. 2023, section 3.2).

    C is the cotangent matrix (negative semi-definite, no unit), M the Voronoi mass (an area), `length` = l in the mesh's
    unit: with a length of the body's own the minimiser does not depend on the unit.

    Returns:
        (N, N) symmetric, positive semi-definite; its null space on a component is the constants.
    """
    stiffness, mass = laplacian_and_mass(mesh, kind=laplacian)
    return sp.csc_matrix(-stiffness + length**2 * (stiffness @ sp.diags(1.0 / mass) @ stiffness))


def solve_quadratic(energy: sp.csc_matrix, linear: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Minimise `tr(W' Q W) - 2 tr(W' B)` with the rows `known` fixed.

    One factorisation of the free block serves all columns.

    Args:
        energy: (N, N) symmetric Q, definite on the free rows.
        linear: (N, J) B.
        known: (N,) bool.
        values: (N, J); only the rows `known` are read.

    Returns:
        (N, J) the minimiser.
    """
    out = np.array(values, dtype=np.float64)
    if known.all():
        return out
    free = np.flatnonzero(~known)
    rows = energy[free]
    right = linear[free] - rows[:, known] @ values[known]
    # Minimum degree on the symmetric pattern, pivots on the diagonal: SuperLU as a sparse Cholesky.
    factor = spl.splu(
        rows[:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    out[free] = factor.solve(right)
    return out
