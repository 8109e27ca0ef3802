"""The frame of every triangle: where its Gaussians hang."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.gaussians.quaternions import quat_from_matrix
from smplxpp.core.errors import GeometryWarning, InputError

MIN_EDGE = 1e-6
"""Metres: mean edge lengths are clamped to this, so that no Gaussian gets a scale of zero."""


@dataclass(frozen=True, eq=False)
class TriangleFrames:
    """Frames of F triangles, for any number of leading batch axes.

    Attributes:
        corners: (..., F, 3, 3) corner k of each triangle in [..., k, :], metres.
        rotations: (..., F, 3, 3) world from local; the columns are the normal, the direction from the first corner to
            the middle of the opposite edge, and their cross product.
        quats: (..., F, 4) the same rotations, wxyz of length 1.
        lengths: (..., F) mean edge length, metres.
    """

    corners: Tensor
    rotations: Tensor
    quats: Tensor
    lengths: Tensor

    @property
    def face_count(self) -> int:
        return self.lengths.shape[-1]


def triangle_frames(vertices: Tensor, faces: Tensor) -> TriangleFrames:
    """Frames of triangles, differentiable in the vertices.

    `n = normalize((v2 - v1) x (v3 - v1))`, `q = normalize((v2 + v3) / 2 - v1)`, `R = [n, q, n x q]`, and e the mean
    edge length: TaoAvatar's equations with an outward unit normal for counter-clockwise faces (the printed one points
    inward and is not unit). q lies in the triangle's plane, so that R is a rotation.

    A triangle whose height is lost in rounding gets some normal across its longest direction, constant for gradients,
    with a GeometryWarning; mean edges below `MIN_EDGE` are clamped.

    Args:
        vertices: (..., V, 3) floating point, metres.
        faces: (F, 3) int64 on the same device.

    Raises:
        InputError: other shapes or types.
    """
    if vertices.ndim < 2 or vertices.shape[-1] != 3 or not vertices.is_floating_point():
        raise InputError(
            "vertices",
            expected="floating point of shape (..., V, 3)",
            received=f"{vertices.dtype} of shape {tuple(vertices.shape)}",
        )
    if faces.ndim != 2 or faces.shape[-1] != 3 or faces.dtype != torch.int64:
        raise InputError(
            "faces", expected="int64 of shape (F, 3)", received=f"{faces.dtype} of shape {tuple(faces.shape)}"
        )
    corners = vertices[..., faces, :]
    v1, v2, v3 = corners.unbind(-2)
    to_second, to_third = v2 - v1, v3 - v1
    cross = torch.linalg.cross(to_second, to_third)
    median = 0.5 * (to_second + to_third)
    lengths = (to_second.norm(dim=-1) + to_third.norm(dim=-1) + (v3 - v2).norm(dim=-1)) / 3.0
    cross, median = _clamp_degenerate(cross, median, to_second, lengths)
    n = cross / cross.norm(dim=-1, keepdim=True)
    q = median / median.norm(dim=-1, keepdim=True)
    rotations = torch.stack([n, q, torch.linalg.cross(n, q)], -1)
    return TriangleFrames(corners, rotations, quat_from_matrix(rotations), lengths.clamp_min(MIN_EDGE))


def _clamp_degenerate(cross: Tensor, median: Tensor, side: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Normals and medians with constants in the place of those that rounding has eaten."""
    with torch.no_grad():
        # Corners a metre from the origin carry an error of one epsilon: about 1e-4 of a 1 mm edge in float32.
        tolerance = 100.0 * torch.finfo(cross.dtype).eps
        degenerate = cross.norm(dim=-1) <= tolerance * lengths.clamp_min(MIN_EDGE) ** 2
        count = int(degenerate.sum())
        if not count:
            return cross, median
        along = torch.where((median.norm(dim=-1) > tolerance * lengths)[..., None], median, side)
        short = along.norm(dim=-1, keepdim=True) <= tolerance * MIN_EDGE
        along = torch.where(short, along.new_tensor([1.0, 0.0, 0.0]), along)
        # The axis that is farthest from `along`, so that the cross product is long.
        axis = torch.nn.functional.one_hot(along.abs().argmin(-1), 3).to(along)
        across = torch.linalg.cross(along, axis)
    warnings.warn(
        f"{count} triangles without area: Gaussians on them get some normal across the longest direction",
        GeometryWarning,
        stacklevel=3,
    )
    mask = degenerate[..., None]
    return torch.where(mask, across, cross), torch.where(mask, along, median)
