"""Spherical harmonics of degrees 1 to 3 over numpy arrays, in the order and with the signs of 3D Gaussian Splatting."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, Float64, Int

C0 = 0.28209479177387814
"""1 / (2 sqrt(pi)), the harmonic of degree 0."""
MOST_COEFFICIENTS = 15
"""Of degrees 1 to 3, which is as far as the files go."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
_BLOCK = 4096  # splats turned at a time: a matrix of 32 x K numbers each


def sh_basis(directions: Float[np.ndarray, "*B 3"], degree: int) -> Float64[np.ndarray, "*B K"]:
    """Return the harmonics of degrees 1 to `degree` at unit directions: degree 1 is `C1 (-y, z, -x)`.

    The numbers are those of `avatar.gaussians.spherical_harmonics`, where torch needs gradients to them.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    terms = [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
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
    return np.stack(terms, axis=-1) if degree else np.zeros((*x.shape, 0))


def rotate_sh(
    sh: Float[np.ndarray, "N K 3"], rotations: Float[np.ndarray, "R 3 3"], of: Int[np.ndarray, " N"]
) -> Float64[np.ndarray, "N K 3"]:
    """Return coefficients after a turn of the function: `sum_k out_k Y_k(R d) = sum_k sh_k Y_k(d)` for every `d`.

    Found from values at fixed directions by least squares, which is exact: the turned function is in the span.

    Args:
        rotations: some. of: which of them turns each splat.
    """
    degree = round((sh.shape[1] + 1) ** 0.5) - 1
    out = np.zeros(sh.shape)
    if not degree:
        return out
    directions, solve = _samples(degree)
    for begin in range(0, len(sh), _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        # Values at d of the turned function are values at R^T d of the function as it was.
        basis = sh_basis(directions @ np.asarray(rotations, np.float64)[of[rows]], degree)
        out[rows] = solve @ (basis @ sh[rows])
    return out


@cache
def _samples(degree: int) -> tuple[Float64[np.ndarray, "S 3"], Float64[np.ndarray, "K S"]]:
    """Return directions spread over the sphere, and what takes values there to coefficients."""
    k = np.arange(32) + 0.5
    z = 1.0 - 2.0 * k / len(k)
    angle, radius = np.pi * (1.0 + 5.0**0.5) * k, np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return directions, np.linalg.pinv(sh_basis(directions, degree))
