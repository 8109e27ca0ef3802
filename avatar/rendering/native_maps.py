"""Kernels of the native library for mesh maps: float32 on the CPU, with gradients (see maps.cpp)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.rendering.barycentrics import ray_from_pixel
from avatar.rendering.memory import pooled_empty
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.native import address, native_library, thread_count
from smplxpp.raster import MeshMaps


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
        return (grad_points @ pose[:3, :3]).to(vertices.dtype), None, None, None


class InterpolateFunction(torch.autograd.Function):
    """Takes vertex values (V, D), barycentrics (..., 3), faces (F, 3) int32 and face ids (...) int32 to (..., D)."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, barycentric: Tensor, faces: Tensor, face_id: Tensor) -> Tensor:
        if barycentric.shape != (*face_id.shape, 3):
            raise InputError(
                "barycentrics", expected=f"shape {(*face_id.shape, 3)}", received=f"shape {tuple(barycentric.shape)}"
            )
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
