"""Compute the local frame of every triangle, to which its Gaussians are bound."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from avatar.gaussians.native_kernels import FramesFunction, is_native
from avatar.gaussians.tensor_operations import quat_from_matrix
from smplxpp.core.errors import GeometryWarning, InputError, one_line

MIN_EDGE = 1e-6
"""Smallest mean edge length, metres. Shorter ones are clamped, so that no Gaussian gets a scale of zero."""


@dataclass(frozen=True, eq=False)
class TriangleFrames:
    """Frames of F triangles, for any number of leading batch axes.

    Attributes:
        corners: corner k of each triangle in [..., k, :], metres.
        rotations: world from local; the columns are the normal, the direction from the first corner to
            the middle of the opposite edge, and their cross product.
        quats: the same rotations, wxyz of length 1.
        lengths: mean edge length, metres.
    """

    corners: Float[Tensor, "*B F 3 3"]
    rotations: Float[Tensor, "*B F 3 3"]
    quats: Float[Tensor, "*B F 4"]
    lengths: Float[Tensor, "*B F"]

    __repr__ = one_line

    @property
    def face_count(self) -> int:
        """The number of triangles, F, of each batch entry."""
        return self.lengths.shape[-1]


def triangle_frames(vertices: Float[Tensor, "*B V 3"], faces: Int64[Tensor, "F 3"]) -> TriangleFrames:
    """Return the frames of triangles, differentiable in the vertices.

    `n = normalize((v2 - v1) x (v3 - v1))`, `q = normalize((v2 + v3) / 2 - v1)`, `R = [n, q, n x q]`, and e the mean
    edge length: TaoAvatar's equations with an outward unit normal for counter-clockwise faces (the printed one points
    inward and is not unit). q lies in the triangle's plane, so that R is a rotation.

    A triangle whose height vanishes in rounding gets an arbitrary normal across its longest direction, constant for
    gradients, with a GeometryWarning on the CPU; mean edges below `MIN_EDGE` are clamped. float32 on the CPU goes
    through the native library.

    Args:
        vertices: metres.
        faces: on the same device.

    Raises:
        InputError: other shapes or types, indices out of range.
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
    if faces.device.type == "cpu" and faces.numel():
        low, high = (int(bound) for bound in faces.aminmax())
        if low < 0 or high >= vertices.shape[-2]:
            raise InputError("faces", expected=f"indices in [0, {vertices.shape[-2]})", received=f"[{low}, {high}]")
    # The native kernel and its oracle return the same tensors.
    if is_native(vertices):
        *arrays, degenerate = FramesFunction.apply(vertices, faces)
    else:
        *arrays, degenerate = triangle_frames_reference(vertices, faces)
    # On a GPU the answer would have to be waited for.
    if degenerate.device.type == "cpu" and degenerate:
        warnings.warn(
            f"{int(degenerate)} triangles without area: Gaussians on them get some normal across the longest direction",
            GeometryWarning,
            stacklevel=2,
        )
    return TriangleFrames(*arrays)


def triangle_frames_reference(
    vertices: Float[Tensor, "*B V 3"], faces: Int64[Tensor, "F 3"]
) -> tuple[
    Float[Tensor, "*B F 3 3"],
    Float[Tensor, "*B F 3 3"],
    Float[Tensor, "*B F 4"],
    Float[Tensor, "*B F"],
    Int64[Tensor, ""],
]:
    """Return the tensors of `TriangleFrames` and the number of triangles without area, in plain torch.

    It is the oracle of the native kernel, and is used for other types and devices.
    """
    # |cross| is twice the area; `median` runs from the first corner to the middle of the opposite edge, in the plane.
    corners = vertices[..., faces, :]
    v1, v2, v3 = corners.unbind(-2)
    to_second, to_third = v2 - v1, v3 - v1
    cross = torch.linalg.cross(to_second, to_third)
    median = 0.5 * (to_second + to_third)
    lengths = (to_second.norm(dim=-1) + to_third.norm(dim=-1) + (v3 - v2).norm(dim=-1)) / 3.0
    with torch.no_grad():
        # Corners a metre from the origin carry an error of one epsilon: about 1e-4 of a 1 mm edge in float32.
        tolerance = 100.0 * torch.finfo(cross.dtype).eps
        degenerate = cross.norm(dim=-1) <= tolerance * lengths.clamp_min(MIN_EDGE) ** 2
        # A direction to keep for a triangle without area: its median, else an edge, else the x axis if it is a point.
        along = torch.where((median.norm(dim=-1) > tolerance * lengths)[..., None], median, to_second)
        short = along.norm(dim=-1, keepdim=True) <= tolerance * MIN_EDGE
        # The x axis without a copy from the CPU, for which a GPU would be waited.
        x_axis = torch.zeros_like(along)
        x_axis[..., 0] = 1.0
        along = torch.where(short, x_axis, along)
        # The axis that is farthest from `along`, so that the cross product is long.
        axis = torch.nn.functional.one_hot(along.abs().argmin(-1), 3).to(along)
        across = torch.linalg.cross(along, axis)
    # `torch.where` passes no gradient to the branch that was not taken, so the substitutes act as constants.
    cross = torch.where(degenerate[..., None], across, cross)
    median = torch.where(degenerate[..., None], along, median)
    # Columns of R: unit normal, unit median, and their cross product; orthonormal because the median is in the plane.
    n = cross / cross.norm(dim=-1, keepdim=True)
    q = median / median.norm(dim=-1, keepdim=True)
    rotations = torch.stack([n, q, torch.linalg.cross(n, q)], -1)
    return corners, rotations, quat_from_matrix(rotations), lengths.clamp_min(MIN_EDGE), degenerate.sum()
