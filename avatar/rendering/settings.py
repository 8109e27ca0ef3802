"""Define the settings and results of every rasteriser backend, and check its arguments before a kernel reads them.

Every error names the argument, the expected and the received value. The checks of values read each tensor once, which
takes about 1 % of the rasterisation of a large scene. On a GPU they wait for it.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from smplxpp.core.errors import InputError, one_line
from smplxpp.native import MOST_SIDE

# Rules of 3D Gaussian Splatting, the same in all backends and kernels.
ALPHA_MAX = 0.999
"""Opacity of one Gaussian at a pixel is clamped to this."""
ALPHA_MIN = 1.0 / 255.0
"""A Gaussian fainter than this at a pixel is skipped there."""
TRANSMITTANCE_MIN = 1e-4
"""Blending stops before the Gaussian that would bring the transmittance to this or below."""


@dataclass(frozen=True)
class RasterSettings:
    """Image size and constants of a rasterisation, the same for every camera of the batch.

    Attributes:
        width: pixels.
        height: pixels.
        near: metres along the camera's z; Gaussians with a nearer centre are dropped.
        far: metres along the camera's z; Gaussians with a farther centre are dropped.
        eps2d: pixels squared, added to the diagonal of the projected covariance (the low-pass filter of 3DGS).
        camera_gradients: whether `viewmats` get gradients.
    """

    width: int
    height: int
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    camera_gradients: bool = False


@dataclass(frozen=True)
class RasterMeta:
    """Intermediate results of a backend, without gradients except for `depth`.

    Attributes:
        means2d: projected centres in pixels; 0 where culled.
        radii: half width and height in pixels of the box that can reach `ALPHA_MIN` (gsplat rounds them up);
            0 where culled.
        depths: metres along the camera's z, of culled Gaussians too.
        depth: accumulated or expected depth in metres, if requested.
    """

    means2d: Float[Tensor, "C N 2"]
    radii: Float[Tensor, "C N 2"]
    depths: Float[Tensor, "C N"]
    depth: Float[Tensor, "C H W 1"] | None = None

    __repr__ = one_line

    @property
    def visible(self) -> Bool[Tensor, "C N"]:
        """Mask of the Gaussians that can reach a pixel of the image."""
        return (self.radii > 0).all(-1)


FEATURE_MAX = 1e20
"""Largest feature in single precision: gradients are sums over pixels of its products, and would overflow above it."""
QUAT_NORM_MIN = 1e-12
"""Shortest quaternion; the direction of a shorter one is lost in rounding."""
ROTATION_TOLERANCE = 1e-3
"""Largest accepted entry of R R^T - I: float32 matrices multiplied along a chain pass, a scale or a shear does not."""

_RANGES = {
    "scales": (math.ulp(0.0), math.inf),
    "opacities": (0.0, 1.0),
    "features": (-FEATURE_MAX, FEATURE_MAX),
    "background": (-FEATURE_MAX, FEATURE_MAX),
}
"""Accepted ranges of values, both ends included."""


def checked_settings(settings: RasterSettings) -> RasterSettings:
    """Return image size, clipping planes and blur as Python's own numbers (numpy's are converted).

    Raises:
        InputError: one of them cannot be used.
    """
    # Each setting alone first, then the relations between them.
    for name in ("width", "height"):
        value = getattr(settings, name)
        if not isinstance(value, numbers.Integral) or isinstance(value, bool) or not 1 <= int(value) <= MOST_SIDE:
            raise InputError(name, expected=f"an integer of 1 to {MOST_SIDE}, in pixels", received=repr(value))
    for name in ("near", "far", "eps2d"):
        if not isinstance(getattr(settings, name), numbers.Real) or not math.isfinite(getattr(settings, name)):
            raise InputError(name, expected="a finite number", received=repr(getattr(settings, name)))
    # A Gaussian at depth 0 has no projection, and a negative blur would make covariances indefinite.
    if not 0 < settings.near < settings.far:
        raise InputError("near, far", expected="0 < near < far, in metres", received=f"{settings.near}, {settings.far}")
    if settings.eps2d < 0:
        raise InputError("eps2d", expected="0 or more, in pixels squared", received=repr(settings.eps2d))
    return RasterSettings(
        width=int(settings.width),
        height=int(settings.height),
        near=float(settings.near),
        far=float(settings.far),
        eps2d=float(settings.eps2d),
        camera_gradients=settings.camera_gradients,
    )


def check_layout(tensors: Mapping[str, Tensor], background: Tensor | None) -> None:
    """Require fitting types and shapes, one dtype and device; `tensors` holds all arguments but the background by name.

    Raises:
        InputError: names the first argument that does not fit the ones before it.
    """
    # Types first, because the shapes below are read from tensors; `means` defines N, and `viewmats` defines C.
    given = dict(tensors) if background is None else {**tensors, "background": background}
    for name, value in given.items():
        if not isinstance(value, Tensor):
            raise InputError(name, expected="a torch tensor", received=type(value).__name__)
    count = _check_shape(tensors, "means", ("N", 3))["N"]
    _check_shape(tensors, "quats", (count, 4))
    _check_shape(tensors, "scales", (count, 3))
    _check_shape(tensors, "opacities", (count,))
    cameras = _check_shape(tensors, "viewmats", ("C", 4, 4))["C"]
    _check_shape(tensors, "Ks", (cameras, 3, 3))
    # Features are (N, D) for all cameras or (C, N, D) for each, and D is free.
    received = tuple(tensors["features"].shape)
    if received[:-1] not in ((count,), (cameras, count)) or received[-1] == 0:
        raise InputError(
            "features",
            expected=f"shape ({count}, D) or ({cameras}, {count}, D), with D of 1 or more",
            received=f"shape {received}",
        )
    channels = received[-1]
    if background is not None and background.shape not in ((channels,), (cameras, channels)):
        raise InputError(
            "background",
            expected=f"shape ({channels},) or ({cameras}, {channels})",
            received=f"shape {tuple(background.shape)}",
        )
    _check_dtype_and_device(given)


def check_values(tensors: Mapping[str, Tensor], background: Tensor | None) -> None:
    """Require finite numbers, positive scales, opacities in [0, 1], quaternions that are not 0, usable cameras.

    Features and background of single precision may not exceed `FEATURE_MAX`.

    Raises:
        InputError: names the argument and how many of its rows are at fault.
    """
    values = {name: tensor.detach() for name, tensor in tensors.items()}
    if background is not None:
        values["background"] = background.detach()
    # A quick test of all arguments in one transfer from the device; only those that fail it are examined exactly.
    for name in _suspects(values):
        _check_exactly(name, values[name])
    _check_viewmats(values["viewmats"].cpu().double().numpy())
    _check_Ks(values["Ks"].cpu().double().numpy())


def _check_shape(tensors: Mapping[str, Tensor], name: str, shape: tuple[int | str, ...]) -> dict[str, int]:
    """Return the sizes of the axes that `shape` names by a letter; the others must be as given."""
    received = tuple(tensors[name].shape)
    if len(received) != len(shape) or any(
        not isinstance(want, str) and want != got for want, got in zip(shape, received, strict=True)
    ):
        expected = ", ".join(str(size) for size in shape) + ("," if len(shape) == 1 else "")
        raise InputError(name, expected=f"shape ({expected})", received=f"shape {received}")
    return {want: got for want, got in zip(shape, received, strict=True) if isinstance(want, str)}


def _check_dtype_and_device(given: Mapping[str, Tensor]) -> None:
    first = given["means"]
    if first.dtype not in (torch.float32, torch.float64):
        raise InputError(
            "means", expected="float32 or float64", received=str(first.dtype), remedy="call .float() on it"
        )
    for name, value in given.items():
        if value.dtype != first.dtype:
            raise InputError(name, expected=f"{first.dtype} as means has", received=str(value.dtype))
        if value.device != first.device:
            raise InputError(name, expected=f"device {first.device} as means has", received=f"device {value.device}")


def _suspects(values: Mapping[str, Tensor]) -> list[str]:
    """Return the arguments that a quick look cannot clear.

    A sum is finite unless a term is not (or it overflows, which the exact look then clears), and is several times
    cheaper than `isfinite`; minimum and maximum hand a NaN on.
    """
    # Minimum and maximum where a range is required, else a sum. Quaternions also get the smallest |w|, because one
    # whose w is not 0 has a length.
    filled = {name: value for name, value in values.items() if value.numel() > 0}
    looks: dict[str, tuple[Tensor, ...]] = {
        name: tuple(torch.aminmax(value)) if name in _RANGES else (value.sum(),) for name, value in filled.items()
    }
    if "means" in filled:
        looks["quats"] += (filled["quats"][:, 0].abs().min(),)
    # One transfer for all statistics: on a GPU every `.item()` would wait for the device.
    flat = [stat for stats in looks.values() for stat in stats]
    answers = iter(torch.stack(flat).tolist() if flat else [])
    found = {name: [next(answers) for _ in stats] for name, stats in looks.items()}
    return [name for name, stats in found.items() if not _is_clear(name, stats)]


def _is_clear(name: str, stats: list[float]) -> bool:
    if not all(math.isfinite(stat) for stat in stats):
        return False
    if name in _RANGES:
        low, high = _RANGES[name]
        return low <= stats[0] and stats[1] <= high
    # A quaternion with a first component is not 0; the others deserve the exact look.
    return name != "quats" or stats[1] >= QUAT_NORM_MIN


def _check_exactly(name: str, value: Tensor) -> None:
    # NaN first, because comparisons below are false for it.
    finite = torch.isfinite(value)
    if not finite.all():
        count = int((~finite).sum())
        raise InputError(name, expected="finite numbers", received=f"{count} of {value.numel()} NaN or infinite")
    if name in ("features", "background") and value.dtype == torch.float32:
        bad = (value.abs() > FEATURE_MAX).flatten()
        _raise_if_any(name, bad, f"magnitudes up to {FEATURE_MAX:g} in single precision", "larger")
    if name == "scales":
        _raise_if_any(name, (value <= 0).any(-1), "positive standard deviations in metres", "zero or negative")
    elif name == "opacities":
        _raise_if_any(name, (value < 0) | (value > 1), "values in [0, 1]", "outside", "pass them through a sigmoid")
    elif name == "quats":
        short = torch.linalg.vector_norm(value, dim=-1) < QUAT_NORM_MIN
        _raise_if_any(name, short, "quaternions with a direction", "of length 0", "use (1, 0, 0, 0) for no rotation")


def _raise_if_any(name: str, bad: Tensor, expected: str, fault: str, remedy: str = "") -> None:
    if bad.any():
        first = int(bad.nonzero()[0, 0])
        received = f"{int(bad.sum())} of {len(bad)} {fault}, the first is number {first}"
        raise InputError(name, expected=expected, received=received, remedy=remedy)


def _check_viewmats(viewmats: np.ndarray) -> None:
    # A rotation satisfies R R^T = I and has determinant 1; a determinant of -1 is a reflection.
    rotations = viewmats[:, :3, :3]
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
    for camera in np.flatnonzero((off > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0))[:1]:
        fault = f"R R^T - I up to {off[camera]:.2g}" if off[camera] > ROTATION_TOLERANCE else "a mirror image"
        raise InputError(
            "viewmats",
            expected="rigid transforms from world to camera: a rotation in the upper left 3 x 3",
            received=f"{fault} in camera {camera}",
            remedy="scale the scene rather than the camera",
        )
    _check_last_row("viewmats", viewmats)


def _check_Ks(Ks: np.ndarray) -> None:
    skew_tolerance = 1e-6  # skew accepted as rounding, as a share of the focal length
    focal, skew = Ks[:, [0, 1], [0, 1]], np.abs(Ks[:, [0, 1], [1, 0]])
    for camera in np.flatnonzero((focal <= 0).any(1))[:1]:
        received = f"{focal[camera].tolist()} in camera {camera}"
        raise InputError("Ks", expected="positive focal lengths in pixels", received=received)
    for camera in np.flatnonzero((skew > skew_tolerance * focal).any(1))[:1]:
        raise InputError(
            "Ks",
            expected="intrinsics without skew (K[0, 1] = K[1, 0] = 0)",
            received=f"{skew[camera].max():.3g} in camera {camera}",
            remedy="resample the image to square axes",
        )
    _check_last_row("Ks", Ks)


def _check_last_row(name: str, matrices: np.ndarray) -> None:
    wanted = np.eye(matrices.shape[-1])[-1]
    for camera in np.flatnonzero((matrices[:, -1] != wanted).any(1))[:1]:
        raise InputError(
            name,
            expected=f"last row {wanted.astype(int).tolist()}",
            received=f"{matrices[camera, -1].tolist()} in camera {camera}",
            remedy="transpose it if its translation stands in the last row" if name == "viewmats" else "",
        )
