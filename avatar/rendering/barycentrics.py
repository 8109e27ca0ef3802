"""Compute barycentrics at known faces and interpolate values: native kernels, and their oracle in plain torch."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Int32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.rendering.memory import pooled_empty
from smplxpp.core import Camera, InputError
from smplxpp.native import address, native_library, thread_count
from smplxpp.raster import MeshMaps


def ray_from_pixel(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Return what takes (px, py, 1) to the camera's frame: a pinhole's ray at depth 1, or x and y of a parallel ray."""
    K = np.eye(3)
    K[:2] = camera.K[:2]
    return np.linalg.inv(K)


def barycentrics_reference(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], face_id: Int32[Tensor, "H W"], camera: Camera
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Return barycentrics and depth of the point of face `face_id` that a pixel's ray meets.

    With r the ray and a, b, c the corners in the camera's frame, `w_a = r . (b x c)` and so on, and the barycentrics
    are `w / sum(w)`: the point `sum(w p) / sum(w)` lies on the ray. For parallel rays r and the corners have 1 for z.
    Computed in float64 and returned in the vertices' type; differentiable in the vertices.
    """
    # Corners of the visible face of each covered pixel, in the camera's frame, metres.
    hit = face_id >= 0
    pose = torch.from_numpy(camera.cam_from_world).to(vertices.device)
    cam = vertices.double() @ pose[:3, :3].T + pose[:3, 3]
    corners = cam[faces[face_id[hit].long()]]
    # The ray through each pixel's centre, which lies at +0.5.
    rows, cols = hit.nonzero(as_tuple=True)
    pixels = torch.stack([cols + 0.5, rows + 0.5, torch.ones_like(cols)], dim=-1).double()
    ray = pixels @ torch.from_numpy(ray_from_pixel(camera)).to(pixels.device).T
    points = torch.cat([corners[..., :2], torch.ones_like(corners[..., 2:])], -1) if camera.orthographic else corners
    # Scalar triple products r . (b x c) are six times the signed volumes of tetrahedra from the camera's centre; their
    # ratios are the barycentrics of the point in which the ray meets the plane of the face, correct in perspective.
    a, b, c = points.unbind(1)
    weights = torch.stack([(ray * torch.cross(p, q, dim=-1)).sum(-1) for p, q in ((b, c), (c, a), (a, b))], dim=-1)
    weights = weights / weights.sum(-1, keepdim=True)
    # Depth is linear in the barycentrics. Background pixels get weight 0 and an infinite depth.
    z = (weights * corners[..., 2]).sum(-1)
    barycentric = vertices.new_zeros((*face_id.shape, 3)).index_put((rows, cols), weights.to(vertices.dtype))
    return barycentric, vertices.new_full(face_id.shape, torch.inf).index_put((rows, cols), z.to(vertices.dtype))


def interpolate_reference(
    values: Float[Tensor, "V D"],
    barycentric: Float[Tensor, "*P 3"],
    faces: Int[Tensor, "F 3"],
    face_id: Int32[Tensor, "*P"],
    covered: Int64[Tensor, " M"],
) -> Float[Tensor, "*P D"]:
    """Interpolate vertex values at the barycentrics of faces; 0 on the background.

    Args:
        values: of the vertices.
        barycentric: of each pixel in its face.
        faces: vertices of each face.
        face_id: face of each pixel, -1 on the background.
        covered: flat indices of the pixels that have a face.
    """
    corners = faces[face_id.flatten()[covered].long()]
    seen = (barycentric.flatten(end_dim=-2)[covered][..., None] * values[corners]).sum(1)
    flat = seen.new_zeros((face_id.numel(), values.shape[1])).index_put((covered,), seen)
    return flat.view(*face_id.shape, values.shape[1])


class BarycentricFunction(torch.autograd.Function):
    """Takes (V, 3) vertices to barycentrics (H, W, 3) and depth (H, W) as rasterised; gradients reach the vertices."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor, seen: MeshMaps, camera: Camera) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(vertices)
        ctx.constants = faces, seen.face_id, camera
        ctx.set_materialize_grads(False)
        return torch.from_numpy(seen.barycentric), torch.from_numpy(seen.depth)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_barycentric: Tensor | None, grad_depth: Tensor | None) -> tuple[Tensor | None, ...]:
        (vertices,) = ctx.saved_tensors
        faces, face_id, camera = ctx.constants
        # The kernel differentiates in the camera's frame and in float64, since volumes of thin triangles cancel.
        pose = torch.from_numpy(camera.cam_from_world)
        points = vertices.double() @ pose[:3, :3].T + pose[:3, 3]
        gradients = [None if g is None else g.contiguous() for g in (grad_barycentric, grad_depth)]
        grad_points = torch.empty_like(points)
        native_library().smplxpp_barycentric_backward(
            address(points, "float64"),
            *(address(array, "int32") for array in (faces, face_id)),
            *map(address, gradients),
            address(np.ascontiguousarray(ray_from_pixel(camera)), "float64"),
            int(camera.orthographic),
            camera.width,
            ctypes.c_int64(face_id.size),
            ctypes.c_int64(len(points)),
            address(grad_points, "float64"),
            thread_count(torch.get_num_threads()),
        )
        # Back to the world: x_cam = R x + t, so that the gradient by x is R^T g, here with points as rows.
        return (grad_points @ pose[:3, :3]).to(vertices.dtype), None, None, None


class InterpolateFunction(torch.autograd.Function):
    """Takes vertex values (V, D), barycentrics (..., 3), faces (F, 3) int32 and face ids (...) int32 to (..., D)."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, barycentric: Tensor, faces: Tensor, face_id: Tensor) -> Tensor:
        if barycentric.shape != (*face_id.shape, 3):
            raise InputError(
                "barycentrics", expected=f"shape {(*face_id.shape, 3)}", received=f"shape {tuple(barycentric.shape)}"
            )
        # The kernel reads plain row-major arrays; the same contiguous tensors are kept for the backward pass.
        inputs = [t.contiguous() for t in (values, faces, face_id, barycentric)]
        ctx.save_for_backward(*inputs)
        out = pooled_empty(*face_id.shape, values.shape[1])
        native_library().smplxpp_interpolate(
            *_addresses(inputs),
            *map(ctypes.c_int64, (face_id.numel(), len(values), len(faces), values.shape[1])),
            address(out),
            thread_count(torch.get_num_threads()),
        )
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        values, _, face_id, barycentric = inputs
        # The kernel skips the gradients whose address is null, because no leaf of the graph needs them.
        grad_values = torch.empty_like(values) if ctx.needs_input_grad[0] else None
        grad_barycentric = pooled_empty(*barycentric.shape) if ctx.needs_input_grad[1] else None
        native_library().smplxpp_interpolate_backward(
            *_addresses(inputs),
            address(grad.contiguous()),
            *map(ctypes.c_int64, (face_id.numel(), *values.shape)),
            address(grad_values),
            address(grad_barycentric),
            thread_count(torch.get_num_threads()),
        )
        return grad_values, grad_barycentric, None, None


def _addresses(inputs: Sequence[Tensor]) -> list[ctypes.c_void_p]:
    """Values, faces, face ids and barycentrics as the kernels take them."""
    return [address(t, dtype) for t, dtype in zip(inputs, ("float32", "int32", "int32", "float32"), strict=True)]
