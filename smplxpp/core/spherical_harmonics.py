"""Evaluate and rotate real spherical harmonics of degrees 0 to 3, for numpy arrays and torch tensors.

Order and signs are those of 3D Gaussian Splatting: m = -l..l in every degree, with the Condon-Shortley phase, so that
degree 1 is `C1 (-y, z, -x)` (Sloan, Stupid Spherical Harmonics Tricks, 2008, appendix A2). numpy computes in float64,
torch in the tensors' own type, with gradients.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int

from smplxpp.core.errors import InputError
from smplxpp.core.rotations import Array, array_namespace

C0 = 0.28209479177387814
"""1 / (2 sqrt(pi)), the harmonic of degree 0."""
MAX_DEGREE = 3
# Normalisation constants of degrees 1 to 3, which make the harmonics orthonormal over the sphere.
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def coefficient_count(degree: int) -> int:
    """Return the number of coefficients of degrees 1 to `degree`: 0, 3, 8, 15.

    Raises:
        InputError: a degree outside 0 to 3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise InputError("degree of spherical harmonics", expected="0, 1, 2 or 3", received=str(degree))
    return (degree + 1) ** 2 - 1


def degree_of(sh: Float[Array, "*N K 3"]) -> int:
    """Return the degree of coefficients of degree 1 and up: 0 to 3 for K = 0, 3, 8, 15."""
    return int((sh.shape[-2] + 1) ** 0.5) - 1


def sh_basis(directions: Float[Array, "*B 3"], degree: int) -> Float[Array, "*B K"]:
    """Return the harmonics of degrees 1 to `degree` at unit directions.

    Degree 0 is left out, because colours store its contribution as a plain number.

    Args:
        directions: of length 1.
        degree: 0 to 3; K is `(degree + 1)^2 - 1`.

    Raises:
        InputError: a degree outside 0 to 3.
    """
    coefficient_count(degree)
    xp = array_namespace(directions)
    if xp is np:
        x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
        return np.stack(_terms(x, y, z, degree), axis=-1) if degree else np.zeros((*x.shape, 0))
    x, y, z = directions.unbind(-1)
    return xp.stack(_terms(x, y, z, degree), -1) if degree else x.new_zeros((*x.shape, 0))


def _terms(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """Return the polynomials of degrees 1 to `degree` in the coordinates of a unit vector."""
    terms: list[Any] = []
    if degree > 0:
        # The Condon-Shortley signs and the order -m..m are those of the reference implementation of Gaussian
        # splatting.
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        terms += [_C2[0] * x * y, -_C2[0] * y * z, _C2[1] * (2 * zz - xx - yy), -_C2[0] * x * z, _C2[2] * (xx - yy)]
    if degree > 2:
        terms += [
            -_C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            -_C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -_C3[2] * x * (4 * zz - xx - yy),
            _C3[4] * z * (xx - yy),
            -_C3[0] * x * (xx - 3 * yy),
        ]
    return terms


def rotate_sh(
    sh: Float[Array, "N K 3"], rotations: Float[Array, "R 3 3"], index: Int[np.ndarray, " N"] | None = None
) -> Float[Array, "N K 3"]:
    """Return the coefficients of the rotated function: `sum_k out_k Y_k(R d) = sum_k sh_k Y_k(d)` for every direction.

    A rotation mixes the harmonics of one degree among themselves. The new coefficients are the least-squares fit to
    values at fixed directions, which is exact because the rotated function lies in the span of the harmonics.

    Args:
        sh: coefficients of degree 1 and up.
        rotations: one for each row of `sh`, or any number with an `index` (numpy only).
        index: the rotation of each row; None: its own.
    """
    degree = degree_of(sh)
    if array_namespace(sh) is not np:
        return _rotate_tensors(sh, rotations, degree) if degree else sh
    out = np.zeros(sh.shape)
    if not degree:
        return out
    # Directions (S, 3) and the (K, S) pseudo-inverse of their harmonics.
    directions, solve = _sample_directions(degree)
    rows_of = np.arange(len(sh)) if index is None else index
    block = 4096  # rows rotated at once: each takes a matrix of 32 x K numbers
    for begin in range(0, len(sh), block):
        rows = slice(begin, begin + block)
        # Values of the rotated function at d are values of the original function at R^T d.
        basis = sh_basis(directions @ np.asarray(rotations, np.float64)[rows_of[rows]], degree)
        out[rows] = solve @ (basis @ sh[rows])
    return out


def _rotate_tensors(sh: Any, rotations: Any, degree: int) -> Any:
    """Rotate coefficients in torch, one rotation a row."""
    xp = array_namespace(sh)
    directions, solve = (xp.as_tensor(array).to(sh) for array in _sample_directions(degree))
    basis = sh_basis(xp.einsum("sj,njk->nsk", directions, rotations), degree)
    return solve @ (basis @ sh)


@cache
def _sample_directions(degree: int) -> tuple[Float64[np.ndarray, "S 3"], Float64[np.ndarray, "K S"]]:
    """Return 32 directions of a Fibonacci lattice, and the pseudo-inverse from values there to coefficients."""
    k = np.arange(32) + 0.5
    z = 1.0 - 2.0 * k / len(k)
    angle, radius = np.pi * (1.0 + 5.0**0.5) * k, np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return directions, np.linalg.pinv(sh_basis(directions, degree))
