"""The C interface of the CPU rasteriser: structures that mirror smplxpp/native/gaussian.hpp, and pooled workspaces."""

from __future__ import annotations

import ctypes
import threading
from functools import cache

import torch
from torch import Tensor

from avatar.render.settings import RasterSettings
from smplxpp.native import native_library

STAGES = ("project", "sort", "bin", "blend", "unblend", "chain")
"""Stages of a forward (the first four) and a backward pass, as they are timed."""
IDLE_BYTES = 2 << 30
"""Workspaces beyond this much memory are freed rather than kept for the next call."""

_POINTER = ctypes.c_void_p


class _Scene(ctypes.Structure):
    _fields_ = [("count", ctypes.c_int64), ("channels", ctypes.c_int32), ("reserved", ctypes.c_int32)]
    _fields_ += [(name, _POINTER) for name in ("means", "quats", "scales", "opacities", "features")]


class _Camera(ctypes.Structure):
    _fields_ = [("width", ctypes.c_int32), ("height", ctypes.c_int32)]
    _fields_ += [(name, ctypes.c_float) for name in ("near", "far", "eps2d")] + [("reserved", ctypes.c_int32)]
    _fields_ += [(name, _POINTER) for name in ("viewmat", "intrinsics", "background")]


class _Gradients(ctypes.Structure):
    _fields_ = [
        (name, _POINTER) for name in ("means", "quats", "scales", "opacities", "features", "viewmat", "background")
    ]
    _fields_ += [("accumulate", ctypes.c_int32), ("accumulate_features", ctypes.c_int32)]


class View:
    """One camera's call: the tensors (float32, contiguous) as the library wants them. It keeps them alive."""

    def __init__(
        self,
        gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
        camera: tuple[Tensor, Tensor, Tensor | None],
        settings: RasterSettings,
    ):
        self.tensors = (*gaussians, *camera)
        count, channels = gaussians[-1].shape
        self.scene = _Scene(count, channels, 0, *map(address, gaussians))
        self.camera = _Camera(
            settings.width,
            settings.height,
            # Limits of float32, which the library takes: beyond them there is nothing to drop.
            *(max(-3e38, min(3e38, value)) for value in (settings.near, settings.far, settings.eps2d)),
            0,
            *map(address, camera),
        )


class Workspace:
    """Memory of the library for one camera, from a forward pass to its backward pass; goes back to the pool by itself.

    `seconds`, if given, are added to by stage, in the order of `STAGES`.
    """

    def __init__(self, level: str | None = None):
        self._library = _library(level)
        self._handle = _POOL.take(self._library)
        self._lock = threading.Lock()

    def __del__(self):
        if getattr(self, "_handle", None):
            _POOL.give_back(self._library, self._handle)

    def forward(self, view: View, outputs: tuple[Tensor, ...], seconds: ctypes.Array | None = None) -> None:
        """Writes image (H, W, D), alpha (H, W), means2d (N, 2), radii (N, 2) and depths (N)."""
        with self._lock:
            failed = self._library.gaussian_forward(
                self._handle, view.scene, view.camera, *map(address, outputs), torch.get_num_threads(), seconds
            )
        _check_memory(failed)

    def backward(
        self,
        view: View,
        radii: Tensor,
        grad_image: Tensor | None,
        grad_alpha: Tensor | None,
        gradients: tuple[Tensor | None, ...],
        accumulate: tuple[bool, bool],
        seconds: ctypes.Array | None = None,
    ) -> None:
        """Gradients of the last forward pass, to means .. features, the pose (3, 4) float64 and the background (D).

        The last two may be None. `accumulate` says whether to add to the first four, and to the features', what is
        otherwise written; the pose's is always added to.
        """
        target = _Gradients(*map(address, gradients), *accumulate)
        with self._lock:
            failed = self._library.gaussian_backward(
                self._handle,
                view.scene,
                view.camera,
                address(radii),
                address(grad_image),
                address(grad_alpha),
                target,
                torch.get_num_threads(),
                seconds,
            )
        _check_memory(failed)

    def counts(self) -> tuple[int, int, int]:
        """Visible Gaussians, entries of all tile lists and visits of blocks in the last forward pass."""
        counts = (ctypes.c_int64 * 3)()
        self._library.gaussian_counts(self._handle, counts)
        return tuple(counts)


class _Pool:
    """Idle workspaces of the library: fresh memory costs more than the arithmetic of a large image."""

    def __init__(self):
        self._lock = threading.Lock()
        self._idle: list[tuple[ctypes.CDLL, int, int]] = []

    def take(self, library: ctypes.CDLL) -> int:
        with self._lock:
            for position in reversed(range(len(self._idle))):
                if self._idle[position][0] is library:
                    return self._idle.pop(position)[1]
        handle = library.gaussian_workspace_new()
        if not handle:
            raise MemoryError("no memory for a workspace of the rasteriser")
        return handle

    def give_back(self, library: ctypes.CDLL, handle: int) -> None:
        # The garbage collector may call this in the middle of `take`: no lock, and nothing but an append.
        size = library.gaussian_workspace_bytes(handle)
        if size + self.idle_bytes <= IDLE_BYTES:
            self._idle.append((library, handle, size))
        else:
            library.gaussian_workspace_free(handle)

    @property
    def idle_bytes(self) -> int:
        return sum(size for _, _, size in list(self._idle))


_POOL = _Pool()


def address(tensor: Tensor | None) -> int | None:
    """Where a tensor's numbers begin."""
    return None if tensor is None else tensor.data_ptr()


def _check_memory(failed: int) -> None:
    if failed:
        raise MemoryError(
            "no memory for the tile lists of the rasteriser: fewer or smaller Gaussians, or a smaller image"
        )


@cache
def _library(level: str | None) -> ctypes.CDLL:
    library = native_library(level)
    pointer, structure = _POINTER, ctypes.POINTER
    library.gaussian_workspace_new.restype = pointer
    library.gaussian_workspace_new.argtypes = []
    library.gaussian_workspace_free.argtypes = [pointer]
    library.gaussian_workspace_free.restype = None
    library.gaussian_workspace_bytes.argtypes = [pointer]
    library.gaussian_workspace_bytes.restype = ctypes.c_int64
    library.gaussian_counts.argtypes = [pointer, pointer]
    library.gaussian_counts.restype = None
    view = [pointer, structure(_Scene), structure(_Camera)]
    library.gaussian_forward.argtypes = [*view, *[pointer] * 5, ctypes.c_int32, pointer]
    library.gaussian_backward.argtypes = [*view, *[pointer] * 3, structure(_Gradients), ctypes.c_int32, pointer]
    return library
