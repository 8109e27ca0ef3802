"""Colour that depends on the view: real spherical harmonics of degrees 0 to 3, as 3D Gaussian Splatting orders them."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.frames import TriangleFrames
from avatar.gaussians.native_kernels import ColorsFunction, is_native
from smplxpp.core.errors import InputError

C0 = 0.28209479177387814
"""1 / (2 sqrt(pi)), the harmonic of degree 0."""
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
MAX_DEGREE = 3


def coefficient_count(degree: int) -> int:
    """Return the number of coefficients of degrees 1 to `degree`: 0, 3, 8, 15.

    Raises:
        InputError: a degree outside 0 to 3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise InputError("degree of spherical harmonics", expected="0, 1, 2 or 3", received=str(degree))
    return (degree + 1) ** 2 - 1


def sh_basis(directions: Float[Tensor, "*B 3"], degree: int) -> Float[Tensor, "*B K"]:
    """Return the harmonics of degrees 1 to `degree` at unit directions, in 3DGS's order and with its signs.

    Order m = -l..l in every degree; Condon-Shortley phase, so that degree 1 is `C1 (-y, z, -x)` (Sloan 2008, appendix
    A2). Degree 0 is not among them: its colour is a plain number.

    Args:
        directions: of length 1.
        degree: 0 to 3; K is `(degree + 1)^2 - 1`.
    """
    coefficient_count(degree)
    x, y, z = directions.unbind(-1)
    terms: list[Tensor] = []
    if degree > 0:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        terms += [
            _C2[0] * x * y,
            -_C2[0] * y * z,
            _C2[1] * (2 * zz - xx - yy),
            -_C2[0] * x * z,
            _C2[2] * (xx - yy),
        ]
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
    return torch.stack(terms, -1) if terms else x.new_zeros((*x.shape, 0))


def sh_color(
    dc: Float[Tensor, "*#B 3"], sh: Float[Tensor, "*#B K 3"], directions: Float[Tensor, "*#B 3"]
) -> Float[Tensor, "*B 3"]:
    """Return the colours seen along unit directions: `max(0, dc + sum_k sh_k Y_k(d))`.

    3DGS's colour is the same with `dc = 0.5 + C0 f_dc`.

    Args:
        directions: in the frame of the coefficients.
    """
    degree = int((sh.shape[-2] + 1) ** 0.5) - 1
    if not degree:
        return dc.clamp_min(0.0).expand(torch.broadcast_shapes(dc.shape, directions.shape))
    basis = sh_basis(directions, degree)
    return (dc + (basis[..., None] * sh).sum(-2)).clamp_min(0.0)


def view_colors(
    bound: BoundGaussians,
    frames: TriangleFrames,
    means: Float[Tensor, "N 3"],
    camera_positions: Float[Tensor, "C 3"],
) -> Float[Tensor, "C N 3"]:
    """Return colours as C cameras see them: `SH(sh, R^-1 d) + dc`, not below 0, R the triangle's rotation.

    Args:
        bound: N Gaussians.
        frames: of one pose.
        means: in the world, as `world_from_frames` gives them.
        camera_positions: centres of projection in the world, metres.

    Returns:
        Colours with gradients to the colours, the means, the frames and the positions.

    Raises:
        InputError: shapes (those of batches of poses too), types or devices that do not fit.
    """
    expected: dict[str, tuple[int | None, ...]] = {
        "rotations": (bound.face_count, 3, 3),
        "means": (len(bound), 3),
        "camera positions": (None, 3),
    }
    received = {"rotations": frames.rotations, "means": means, "camera positions": camera_positions}
    for name, shape in expected.items():
        value = tuple(received[name].shape)
        if len(value) != len(shape) or any(b not in (None, a) for a, b in zip(value, shape, strict=True)):
            raise InputError(f"colours: {name}", expected=f"shape {shape}", received=f"shape {value}")
        if received[name].dtype != bound.dc.dtype or received[name].device != bound.dc.device:
            raise InputError(
                f"colours: {name}",
                expected=f"{bound.dc.dtype} on {bound.dc.device}, as the Gaussians",
                received=f"{received[name].dtype} on {received[name].device}",
            )
    inputs = (frames.rotations, bound.dc, bound.sh, means, camera_positions)
    if is_native(*inputs):
        return ColorsFunction.apply(bound.face_index, *inputs)
    return view_colors_reference(bound, frames, means, camera_positions)


def view_colors_reference(
    bound: BoundGaussians,
    frames: TriangleFrames,
    means: Float[Tensor, "N 3"],
    camera_positions: Float[Tensor, "C 3"],
) -> Float[Tensor, "C N 3"]:
    """Do as `view_colors` in plain torch: the oracle of the native kernel, and the way for other types and devices."""
    directions = torch.nn.functional.normalize(means - camera_positions[:, None], dim=-1)
    rotations = frames.rotations[bound.face_index]
    # R^T d: the sum runs over rows.
    local = (rotations * directions[..., :, None]).sum(-2)
    return sh_color(bound.dc, bound.sh, local)


def rotate_sh(sh: Float[Tensor, "N K 3"], rotations: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N K 3"]:
    """Return coefficients after a turn of the function: `sum_k out_k Y_k(R d) = sum_k sh_k Y_k(d)` for every direction.

    A rotation mixes harmonics of one degree among themselves. Their new coefficients are found from values at fixed
    directions by least squares, which is exact: the turned function is in the span.

    Args:
        rotations: one for each Gaussian.
    """
    degree = int((sh.shape[-2] + 1) ** 0.5) - 1
    if not degree:
        return sh
    directions, solve = (torch.as_tensor(array).to(sh) for array in _samples(degree))
    # Values at d of the turned function are values at R^T d of the function as it was.
    basis = sh_basis(torch.einsum("sj,njk->nsk", directions, rotations), degree)
    return solve @ (basis @ sh)


@cache
def _samples(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (S, 3) spread over the sphere, and (K, S) that takes values there to coefficients."""
    k = np.arange(32) + 0.5
    z = 1.0 - 2.0 * k / len(k)
    angle, radius = np.pi * (1.0 + 5.0**0.5) * k, np.sqrt(1.0 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return directions, np.linalg.pinv(sh_basis(torch.as_tensor(directions), degree).numpy())
