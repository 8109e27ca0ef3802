"""Rasterise on CPUs: the C interface of the native kernels, and autograd around them, one camera after another."""

from __future__ import annotations

import ctypes
import threading
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from avatar.rendering.memory import list_bytes, pooled_empty, too_many_entries
from avatar.rendering.settings import RasterMeta, RasterSettings
from smplxpp.core.errors import InputError
from smplxpp.native import OverLimitError, address, native_library, thread_count

STAGES = ("project", "sort", "bin", "blend", "unblend", "chain")
"""Stages of a forward (the first four) and a backward pass, as they are timed."""
IDLE_BYTES = 2 << 30
"""Total memory of idle workspaces, bytes; more is freed."""

BYTES_OF_ENTRY = 24
"""Bytes of an entry of the tile lists while they are built: 12, twice while a list grows."""

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


class CameraCall:
    """One camera's call: the tensors (float32, contiguous) in the layout of the library. It keeps them alive."""

    def __init__(
        self,
        gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
        camera: tuple[Tensor, Tensor, Tensor | None],
        settings: RasterSettings,
    ) -> None:
        self.tensors = (*gaussians, *camera)
        count, channels = gaussians[-1].shape
        self.scene = _Scene(count, channels, 0, *map(address, gaussians))
        self.camera = _Camera(
            settings.width,
            settings.height,
            # The library takes float32; outside of its range there is nothing to drop.
            *(max(-3e38, min(3e38, value)) for value in (settings.near, settings.far, settings.eps2d)),
            0,
            *map(address, camera),
        )


class Workspace:
    """Memory of the library for one camera, from a forward pass to its backward pass; it returns to the pool by itself.

    `seconds`, if given, are added to by stage, in the order of `STAGES`.
    """

    def __init__(self, level: str | None = None) -> None:
        self._library = _library(level)
        self._handle = _POOL.take(self._library)
        self._lock = threading.Lock()

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            _POOL.give_back(self._library, self._handle)

    def forward(self, view: CameraCall, outputs: tuple[Tensor, ...], seconds: ctypes.Array | None = None) -> None:
        """Write image (H, W, D), alpha (H, W), means2d (N, 2), radii (N, 2) and depths (N).

        Raises:
            InputError: the lists of Gaussians by tile would exceed their memory limit.
            MemoryError: no memory is left.
        """
        # A workspace holds one pass at a time; the lock serialises callers from several threads.
        with self._lock:
            most = list_bytes()
            try:
                self._library.gaussian_forward(
                    self._handle,
                    view.scene,
                    view.camera,
                    *map(address, outputs),
                    most // BYTES_OF_ENTRY,
                    thread_count(torch.get_num_threads()),
                    seconds,
                )
            except OverLimitError:
                # The kernel has projected all Gaussians before it gives
                # up: their boxes tell how many entries were needed.
                _, _, means2d, radii, _ = outputs
                size = (view.camera.width, view.camera.height)
                raise too_many_entries(means2d, radii, size, most, BYTES_OF_ENTRY) from None

    def backward(
        self,
        view: CameraCall,
        radii: Tensor,
        grad_image: Tensor | None,
        grad_alpha: Tensor | None,
        gradients: tuple[Tensor | None, ...],
        accumulate: tuple[bool, bool],
        seconds: ctypes.Array | None = None,
    ) -> None:
        """Write the last forward pass's gradients to means .. features, the pose (3, 4) float64 and the background (D).

        The last two may be None. `accumulate` says whether to add to the first four, and to the features', what is
        otherwise written; the pose's is always added to.
        """
        # The pose is summed over all Gaussians, in float64; the other gradients are float32 as the tensors are.
        *to_tensors, to_pose, to_background = gradients
        addresses = [*map(address, to_tensors), address(to_pose, "float64"), address(to_background)]
        target = _Gradients(*addresses, *accumulate)
        # The library still holds the projected Gaussians and tile lists of the forward pass, which are not built again.
        with self._lock:
            self._library.gaussian_backward(
                self._handle,
                view.scene,
                view.camera,
                address(radii),
                address(grad_image),
                address(grad_alpha),
                target,
                thread_count(torch.get_num_threads()),
                seconds,
            )

    def counts(self) -> tuple[int, int, int]:
        """Count visible Gaussians, entries of all tile lists and visits of blocks in the last forward pass."""
        counts = (ctypes.c_int64 * 3)()
        self._library.gaussian_counts(self._handle, counts)
        return counts[0], counts[1], counts[2]


class _Pool:
    """Idle workspaces of the library: fresh memory costs more than the arithmetic of a large image."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[tuple[ctypes.CDLL, int, int]] = []

    def take(self, library: ctypes.CDLL) -> int:
        # Last in, first out: the few workspaces that are in use at a time stay the same ones.
        with self._lock:
            for position in reversed(range(len(self._idle))):
                if self._idle[position][0] is library:
                    return self._idle.pop(position)[1]
        handle = _POINTER()
        library.gaussian_workspace_new(ctypes.byref(handle))
        assert handle.value is not None  # else the library has raised
        return handle.value

    def give_back(self, library: ctypes.CDLL, handle: int) -> None:
        # The garbage collector may call this in the middle of `take`: no lock, and nothing but an append.
        size = ctypes.c_int64()
        library.gaussian_workspace_bytes(handle, ctypes.byref(size))
        if size.value + self.idle_bytes <= IDLE_BYTES:
            self._idle.append((library, handle, size.value))
        else:
            library.gaussian_workspace_free(handle)

    @property
    def idle_bytes(self) -> int:
        return sum(size for _, _, size in list(self._idle))


_POOL = _Pool()


@cache
def _library(level: str | None) -> ctypes.CDLL:
    library = native_library(level)
    pointer, scene, camera, gradients = _POINTER, *map(ctypes.POINTER, (_Scene, _Camera, _Gradients))
    library.gaussian_workspace_new.argtypes = [pointer]
    library.gaussian_workspace_free.argtypes = [pointer]
    library.gaussian_workspace_bytes.argtypes = [pointer, pointer]
    library.gaussian_counts.argtypes = [pointer, pointer]
    view = (pointer, scene, camera)
    library.gaussian_forward.argtypes = (*view, *[pointer] * 5, ctypes.c_int64, ctypes.c_int32, pointer)
    library.gaussian_backward.argtypes = (*view, *[pointer] * 3, gradients, ctypes.c_int32, pointer)
    return library


MAX_COUNT = 2**31 - 1
"""Largest number of Gaussians, because lists hold 32-bit indices."""


def rasterize_cpu(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    features: Float[Tensor, "N D"] | Float[Tensor, "C N D"],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    background: Float[Tensor, "C D"] | None,
    settings: RasterSettings,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"], RasterMeta]:
    """Return images of D-channel Gaussians in single precision, with gradients to all but `Ks`.

    Runs on `torch.get_num_threads()` threads; the picture is the same for any number of them, the gradients bit for bit
    for a fixed number. Image and alpha are exact to about 1e-6, gradients to about 1e-5 of their largest entry.

    Args:
        means: metres, float32 as all the others.
        quats: wxyz, of any length but 0.
        scales: metres.
        opacities: in [0, 1].
        features: channels, the same for all cameras or those of each.
        viewmats: world to camera, OpenCV's axes.
        Ks: intrinsics in pixels, without skew.
        background: None is 0.
        settings: image size and constants; without `camera_gradients` the poses get none.

    Returns:
        Images, their alpha, and the `RasterMeta`.

    Raises:
        InputError: not float32.
        MemoryError: the lists of Gaussians by tile do not fit.
    """
    # Limits of the kernels: single precision and 32-bit indices.
    if means.dtype != torch.float32:
        raise InputError(
            "means", expected="float32", received=str(means.dtype), remedy='use backend="reference" for float64'
        )
    if len(means) > MAX_COUNT:
        raise InputError("means", expected=f"at most {MAX_COUNT} Gaussians", received=f"{len(means)}")
    if not settings.camera_gradients:
        viewmats = viewmats.detach()
    image, alpha, means2d, radii, depths = _Rasterize.apply(
        means, quats, scales, opacities, features, viewmats, Ks, background, settings
    )
    return image, alpha, RasterMeta(means2d=means2d, radii=radii, depths=depths)


_Inputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]
"""Means, quaternions, scales, opacities, features, poses, intrinsics and background."""


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        background: Tensor | None,
        settings: RasterSettings,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        # Outputs are allocated here, since autograd owns them; the kernels overwrite every entry.
        cameras, count, channels = len(viewmats), len(means), features.shape[-1]
        image = pooled_empty(cameras, settings.height, settings.width, channels)
        alpha = pooled_empty(cameras, settings.height, settings.width, 1)
        means2d, radii = means.new_empty(cameras, count, 2), means.new_empty(cameras, count, 2)
        depths = means.new_empty(cameras, count)
        inputs = (means, quats, scales, opacities, features, viewmats, Ks, background)
        # A backward pass needs its camera's own workspace; without gradients one serves all cameras in turn.
        needed = any(ctx.needs_input_grad)
        ctx.workspaces = [Workspace() for _ in range(cameras if needed else 1)]
        for camera, view in enumerate(_views(inputs, settings)):
            outputs = (image[camera], alpha[camera], means2d[camera], radii[camera], depths[camera])
            ctx.workspaces[camera if needed else 0].forward(view, outputs)
        # Radii decide in the backward pass which Gaussians were visible, so that they are saved beside the inputs.
        ctx.settings = settings
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(means2d, radii, depths)
        ctx.save_for_backward(*inputs, radii)
        return image, alpha, means2d, radii, depths

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        *inputs, radii = ctx.saved_tensors
        *gaussians, features, viewmats, _, background = inputs
        # Neither image nor alpha enters the loss: there is nothing to propagate.
        if grad_image is None and grad_alpha is None:
            return (None,) * 9
        grad_image = None if grad_image is None else grad_image.contiguous()
        grad_alpha = None if grad_alpha is None else grad_alpha.contiguous()
        # The first camera writes these gradients, so that they need no zeros; poses are added to, so that theirs do.
        grads = [torch.empty_like(tensor) for tensor in (*gaussians, features)]
        poses = viewmats.new_zeros(len(viewmats), 3, 4, dtype=torch.float64) if ctx.needs_input_grad[5] else None
        grad_background = torch.empty_like(background) if ctx.needs_input_grad[7] else None
        # Cameras after the first add to the gradients that the first one wrote.
        own_features = features.ndim == 3
        for camera, (view, workspace) in enumerate(
            zip(_views(tuple(inputs), ctx.settings), ctx.workspaces, strict=True)
        ):
            workspace.backward(
                view,
                radii[camera],
                *(None if grad is None else grad[camera] for grad in (grad_image, grad_alpha)),
                (
                    *grads[:4],
                    grads[4][camera] if own_features else grads[4],
                    *(None if grad is None else grad[camera] for grad in (poses, grad_background)),
                ),
                (camera > 0, camera > 0 and not own_features),
            )
        # The last row of a pose is constant (0, 0, 0, 1) and gets gradient 0.
        grad_viewmats = None
        if poses is not None:
            grad_viewmats = torch.zeros_like(viewmats)
            grad_viewmats[:, :3] = poses
        return (*grads, grad_viewmats, None, grad_background, None)


def _views(inputs: _Inputs, settings: RasterSettings) -> list[CameraCall]:
    """Return the arguments of the library for each camera."""
    means, quats, scales, opacities, features, viewmats, Ks, background = inputs
    return [
        CameraCall(
            (means, quats, scales, opacities, features if features.ndim == 2 else features[camera]),
            (viewmats[camera], Ks[camera], None if background is None else background[camera]),
            settings,
        )
        for camera in range(len(viewmats))
    ]
