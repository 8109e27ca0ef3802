"""Pictures of a fit: photograph, rendering and error beside each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from avatar.data.views import read_view
from pipelines.figures import colormap, encode_png, heat_colors
from smplxpp.capture import Capture
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.image_file import open_image

ERROR_LIMIT = 64
"""Difference of the worst channel, of 255, that the error's colours end at."""


Picture = UInt8[np.ndarray, "H W 3"]


def error_colors(real: Picture, rendered: Picture) -> Picture:
    """Colour the largest difference of a channel at every pixel: pale where it is 0, dark from `ERROR_LIMIT` on."""
    worst = np.abs(real.astype(np.int16) - rendered.astype(np.int16)).max(axis=-1)
    return heat_colors(worst.ravel().astype(np.float64), cmap="error", limits=(0.0, ERROR_LIMIT)).reshape(real.shape)


def error_legend(width: int = 384, height: int = 18) -> Picture:
    """Draw the error's colours from 0 on the left to `ERROR_LIMIT`."""
    ramp = colormap("error")[np.linspace(0, 255, width).round().astype(int)]
    return np.repeat(ramp[None], height, axis=0)


def write_strip(path: Path, real: Picture, rendered: Picture) -> None:
    """Write photograph, rendering and error as one PNG of three times the width."""
    strip = np.concatenate([real, rendered, error_colors(real, rendered)], axis=1)
    atomic_write_bytes(path, encode_png(strip))


def read_strip(path: Path) -> tuple[Picture, Picture, Picture]:
    """Read photograph, rendering and error of a strip."""
    strip = np.asarray(open_image(path, subject="picture").convert("RGB"))
    width = strip.shape[1] // 3
    return strip[:, :width], strip[:, width : 2 * width], strip[:, 2 * width :]


def enlarge(image: UInt8[np.ndarray, "_ _ 3"], factor: int) -> UInt8[np.ndarray, "_ _ 3"]:
    """Draw every pixel as a square of `factor` pixels: nothing is smoothed away."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def preview_writer(capture: Capture, folder: Path) -> Callable[[Mapping[str, np.ndarray]], None]:
    """Writes photograph, rendering and error of measured views to `folder/previews/CAM_FFFFFF.png`."""
    background = capture.recording.background or (0.0, 0.0, 0.0)

    def write(images: Mapping[str, np.ndarray]) -> None:
        for name, image in images.items():
            camera, frame = name.rsplit(" ", 1)
            real = read_view(capture, camera, int(frame)).photograph(background)
            write_strip(folder / "previews" / f"{camera}_{int(frame):06d}.png", real, image)

    return write
