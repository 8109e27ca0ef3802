"""Call the native kernels for bound Gaussians: float32 on the CPU, with gradients.

The torch formulas in `frames`, `binding` and `colors` define their results, and are their oracle in tests.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from smplxpp.core.errors import InputError
from smplxpp.native import address, native_library, thread_count

_LOCAL = ("barycentric", "normal_offset", "offset", "log_scales", "quats")
_FRAMES = ("corners", "rotations", "frame_quats", "lengths")


class _Binding(ctypes.Structure):
    """Arguments of the kernels, `SmplxppBinding` of binding.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("face", *_LOCAL, *_FRAMES)),
        ("N", ctypes.c_int64),
        ("F", ctypes.c_int64),
        ("B", ctypes.c_int64),
        ("thickness", ctypes.c_float),
    )


class _BindingGradients(ctypes.Structure):
    """Gradients of the arguments, `SmplxppBindingGradients` of binding.cpp."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("means", "out_quats", "scales", "normals", *_LOCAL, *_FRAMES)]


def is_native(*tensors: Tensor) -> bool:
    """Return whether the kernels take these tensors: all float32 on the CPU."""
    return all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)


class FramesFunction(torch.autograd.Function):
    """Map (..., V, 3) vertices and (F, 3) faces to the tensors of `TriangleFrames` and the number without area."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> tuple[Tensor, ...]:
        vertices, faces = vertices.contiguous(), faces.contiguous()
        # Outputs in the order of `TriangleFrames`: corners, rotations, quaternions, mean edge lengths.
        batch, V, F = vertices.shape[:-2], vertices.shape[-2], len(faces)
        out = [vertices.new_empty((*batch, F, *tail)) for tail in ((3, 3), (3, 3), (4,), ())]
        degenerate = ctypes.c_int64()
        native_library().smplxpp_frames_forward(
            address(vertices),
            address(faces, "int64"),
            *map(ctypes.c_int64, (batch.numel(), V, F)),
            *map(address, out),
            ctypes.byref(degenerate),
            _threads(),
        )
        # The backward pass needs the rotations (out[1]) again. Outputs without a gradient stay None instead of zeros.
        count = torch.tensor(degenerate.value)
        ctx.mark_non_differentiable(count)
        ctx.save_for_backward(vertices, faces, out[1])
        ctx.set_materialize_grads(False)
        return *out, count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor, None]:
        vertices, faces, rotations = ctx.saved_tensors
        batch, V = vertices.shape[:-2], vertices.shape[-2]
        # Triangles share vertices, so the kernel adds to zeros.
        given = _contiguous(gradients[:4])
        out = torch.zeros_like(vertices)
        native_library().smplxpp_frames_backward(
            address(vertices),
            address(faces, "int64"),
            *map(address, (rotations, *given)),
            *map(ctypes.c_int64, (batch.numel(), V, len(faces))),
            address(out),
            _threads(),
        )
        return out, None


class WorldFunction(torch.autograd.Function):
    """Map local attributes and frames, in the order of `_LOCAL` and `_FRAMES`, to means, quats, scales, normals."""

    @staticmethod
    def forward(ctx: Any, thickness: float, face: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        face, inputs = face.contiguous(), tuple(t.contiguous() for t in inputs)
        lengths = inputs[-1]
        _check_frames(dict(zip(_FRAMES, inputs[len(_LOCAL) :], strict=True)))
        batch = lengths.shape[:-1]
        # Means, quaternions, scales, normals.
        out = [lengths.new_empty((*batch, len(face), width)) for width in (3, 4, 3, 3)]
        native_library().smplxpp_world_forward(
            ctypes.byref(_binding(thickness, face, inputs)), *map(address, out), _threads()
        )
        ctx.save_for_backward(face, *inputs)
        ctx.thickness = thickness
        ctx.set_materialize_grads(False)
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        face, *inputs = ctx.saved_tensors
        given = _contiguous(gradients)
        wanted = ctx.needs_input_grad[2:]
        # The kernel writes gradients of Gaussians and adds to those of faces.
        local = [torch.empty_like(t) if want else None for t, want in zip(inputs, wanted, strict=True)][: len(_LOCAL)]
        frames = [torch.zeros_like(t) if want else None for t, want in zip(inputs, wanted, strict=True)][len(_LOCAL) :]
        native_library().smplxpp_world_backward(
            ctypes.byref(_binding(ctx.thickness, face, inputs)),
            ctypes.byref(_BindingGradients(*map(address, (*given, *local, *frames)))),
            _threads(),
        )
        return None, None, *local, *frames


class ColorsFunction(torch.autograd.Function):
    """Map faces of Gaussians, rotations of faces, dc, sh, means and camera positions to (C, N, 3) colours."""

    @staticmethod
    def forward(ctx: Any, face: Tensor, *inputs: Tensor) -> Tensor:
        face, inputs = face.contiguous(), tuple(t.contiguous() for t in inputs)
        sh, cameras = inputs[2], inputs[4]
        out = sh.new_empty((len(cameras), len(face), 3))
        native_library().smplxpp_colors_forward(
            address(face, "int64"),
            *map(address, inputs),
            ctypes.c_int64(len(face)),
            ctypes.c_int64(len(cameras)),
            sh.shape[1],
            address(out),
            _threads(),
        )
        ctx.save_for_backward(face, *inputs)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        face, *inputs = ctx.saved_tensors
        rotations, dc, sh, means, cameras = inputs
        wanted = ctx.needs_input_grad[1:]
        threads = _threads()
        to_rotations = torch.zeros_like(rotations) if wanted[0] else None
        to_dc, to_sh, to_means = (
            torch.empty_like(t) if want else None for t, want in zip((dc, sh, means), wanted[1:4], strict=True)
        )
        # All Gaussians add to the few cameras: each thread has its own row, and the rows are added in a fixed order.
        to_cameras = cameras.new_zeros((threads, *cameras.shape)) if wanted[4] else None
        gradient = gradient.contiguous()
        native_library().smplxpp_colors_backward(
            address(face, "int64"),
            *map(address, (*inputs, gradient)),
            *map(ctypes.c_int64, (len(face), len(rotations), len(cameras))),
            sh.shape[1],
            *map(address, (to_dc, to_sh, to_means, to_rotations, to_cameras)),
            threads,
        )
        return None, to_rotations, to_dc, to_sh, to_means, None if to_cameras is None else to_cameras.sum(0)


def _binding(thickness: float, face: Tensor, inputs: Sequence[Tensor]) -> _Binding:
    lengths = inputs[-1]
    sizes = (len(face), lengths.shape[-1], lengths.shape[:-1].numel())
    return _Binding(address(face, "int64"), *map(address, inputs), *sizes, thickness)


def _check_frames(frames: dict[str, Tensor]) -> None:
    for name, tail in zip(_FRAMES, ((3, 3), (3, 3), (4,), ()), strict=True):
        expected = (*frames["lengths"].shape, *tail)
        if frames[name].shape != expected:
            raise InputError(
                f"frames: {name}", expected=f"shape {expected}", received=f"shape {tuple(frames[name].shape)}"
            )


def _contiguous(tensors: tuple[Tensor | None, ...]) -> list[Tensor | None]:
    return [None if t is None else t.contiguous() for t in tensors]


def _threads() -> int:
    return thread_count(torch.get_num_threads())
