"""Evaluate the view-dependent colours of Gaussians from their spherical harmonics."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.frames import TriangleFrames
from avatar.gaussians.native_kernels import ColorsFunction, is_native
from smplxpp.core.errors import InputError
from smplxpp.core.spherical_harmonics import degree_of, sh_basis


def sh_color(
    dc: Float[Tensor, "*#B 3"], sh: Float[Tensor, "*#B K 3"], directions: Float[Tensor, "*#B 3"]
) -> Float[Tensor, "*B 3"]:
    """Return the colours seen along unit directions: `max(0, dc + sum_k sh_k Y_k(d))`.

    3DGS's colour is the same with `dc = 0.5 + C0 f_dc`.

    Args:
        dc: colours of degree 0.
        sh: coefficients of degree 1 and up.
        directions: of length 1, in the frame of the coefficients.
    """
    # Colours below 0 have no meaning in sRGB; 3DGS clamps them too, and values above 1 are kept.
    degree = degree_of(sh)
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
    """Return the colours seen from C cameras: `max(0, dc + SH(sh, R^-1 d))` with R the rotation of the triangle.

    Args:
        bound: N Gaussians.
        frames: of one pose.
        means: in the world, as `world_from_frames` gives them.
        camera_positions: centres of projection in the world, metres.

    Returns:
        Colours with gradients to the colours, the means, the frames and the positions.

    Raises:
        InputError: wrong shapes (those of batches of poses too), types or devices.
    """
    # The kernel reads raw memory, so shapes, types and devices are checked here.
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
    """Return `view_colors` in plain torch: the oracle of the native kernel, used for other types and devices."""
    # (C, N, 3) unit vectors from each camera to each Gaussian, in the world.
    directions = torch.nn.functional.normalize(means - camera_positions[:, None], dim=-1)
    rotations = frames.rotations[bound.face_index]
    # R^T d, so the sum runs over rows.
    local = (rotations * directions[..., :, None]).sum(-2)
    return sh_color(bound.dc, bound.sh, local)
