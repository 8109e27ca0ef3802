"""Measure the cost of an avatar: milliseconds a picture, parameters, bytes on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import torch
from torch import nn

from avatar.data.views import View
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import AvatarModel, at_rest
from smplxpp.core import BodyParams, Camera, InputError

CONVENTION = (
    "Every picture has a new pose, one after the other. Pose: joints to skinning transforms (numpy on the CPU). "
    "Deform: networks, skinning, Gaussians, colours. Render: rasterising with clamping. Medians after a warm-up; "
    "frames a second are of deform and render together, the image staying where it was made."
)


@dataclass(frozen=True)
class Speed:
    """Medians of the time of one picture.

    Attributes:
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        gaussians: number of drawn Gaussians.
        pose_ms: joints to skinning transforms, milliseconds.
        deform_ms: networks, skinning, Gaussians and colours, milliseconds.
        render_ms: rasterising and clamping, milliseconds.
        fps: pictures a second of deform and render together.
        pictures: number of timed pictures.
        device: name of the GPU, or "CPU".
        threads: of torch and the rasteriser; 0 on a GPU.
    """

    width: int
    height: int
    gaussians: int
    pose_ms: float
    deform_ms: float
    render_ms: float
    fps: float
    pictures: int
    device: str
    threads: int


def measure_speed(
    model: AvatarModel,
    params: Sequence[BodyParams],
    camera: Camera,
    *,
    size: tuple[int, int] = (512, 512),
    pictures: int = 20,
    warmup: int = 3,
    eps2d: float = 0.1,
) -> Speed:
    """Time pictures of a model in the poses of `params`, over and over.

    Args:
        model: the avatar, on the device to measure.
        params: one frame each.
        camera: scaled to `size`, see `fitted`.
        size: width and height, pixels.
        pictures: number of timed pictures.
        warmup: pictures that are drawn first and not timed.
        eps2d: blur of the splats, pixels squared.

    Raises:
        InputError: no pose, no picture.
    """
    if not params or pictures < 1:
        raise InputError(
            "speed", expected="at least one pose and one picture", received=f"{len(params)} and {pictures}"
        )
    # The view and its background live on the model's device, so that no transfer is timed.
    device = model.rig.device
    view = _blank(fitted(camera, *size)).to(device)
    background = torch.zeros(3, device=device)
    now = _clock(device)
    times = []
    # Time three steps of each picture: the pose of the body, the deformation of the Gaussians, and the rendering.
    with at_rest(model):
        for k in range(warmup + pictures):
            begin = now()
            pose = model.rig.pose(params[k % len(params)])
            placed = now()
            posed = model(pose, view.position[None])
            deformed = now()
            render_view(posed, 0, view, background, eps2d=eps2d).image.clamp(0.0, 1.0)
            times.append((placed - begin, deformed - placed, now() - deformed))
    # Drop the warm-up, in which kernels compile and caches fill; the median resists other load on the machine.
    times = times[warmup:]
    pose, deform, render = (median(column) for column in zip(*times, strict=True))
    return Speed(
        *size,
        gaussians=len(posed.bound),
        pose_ms=1e3 * pose,
        deform_ms=1e3 * deform,
        render_ms=1e3 * render,
        fps=1.0 / median(d + r for _, d, r in times),
        pictures=pictures,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU",
        threads=0 if device.type == "cuda" else torch.get_num_threads(),
    )


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera with its whole picture centred in another size, as large as fits.

    Raises:
        InputError: a size below 1.
    """
    if width < 1 or height < 1:
        raise InputError("picture size", expected="at least 1 x 1", received=f"{width} x {height}")
    # Scale by the tighter side; focal lengths and principal point scale with the picture, which is then centred.
    scale = min(width / camera.width, height / camera.height)
    K = camera.K.copy()
    K[:2] *= scale
    K[:2, 2] += 0.5 * (width - scale * camera.width), 0.5 * (height - scale * camera.height)
    return replace(camera, K=K, width=width, height=height)


def parameter_counts(model: AvatarModel | nn.Module) -> dict[str, int]:
    """Count the parameters of a module's parts, "total" last; one that parts share counts once."""
    counts: dict[str, int] = {}
    for name, value in model.named_parameters():
        part = name.split(".")[0]
        counts[part] = counts.get(part, 0) + value.numel()
    return {**counts, "total": sum(counts.values())}


def bytes_on_disk(path: Path) -> int:
    """Return the size of a model file, or of all files of a folder."""
    path = Path(path)
    return sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())


def _blank(camera: Camera) -> View:
    """Return an empty view of a camera."""
    size = (camera.height, camera.width)
    return View(camera, torch.zeros(*size, 3, dtype=torch.uint8), torch.zeros(size, dtype=torch.uint8))


def _clock(device: torch.device) -> Callable[[], float]:
    """Return a clock, in seconds, that waits for the device to finish its work."""

    def now() -> float:
        # CUDA runs asynchronously: without the wait a clock would time the launch of kernels alone.
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    return now
