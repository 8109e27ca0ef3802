"""Pictures of a fit: photograph, rendering and error beside each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from pipelines.figures import colormap, encode_png, heat_colors
from smplxpp.core.atomic import atomic_write_bytes

ERROR_LIMIT = 64
"""Difference of the worst channel, of 255, that the error's colours end at."""


def error_colors(real: np.ndarray, rendered: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the largest difference of a channel at every pixel, pale where 0, dark from `ERROR_LIMIT` on."""
    worst = np.abs(real.astype(np.int16) - rendered.astype(np.int16)).max(axis=-1)
    return heat_colors(worst.ravel(), cmap="error", limits=(0.0, ERROR_LIMIT)).reshape(real.shape)


def error_legend(width: int = 384, height: int = 18) -> np.ndarray:
    """(height, width, 3) uint8: the error's colours from 0 on the left to `ERROR_LIMIT`."""
    ramp = colormap("error")[np.linspace(0, 255, width).round().astype(int)]
    return np.repeat(ramp[None], height, axis=0)


def write_strip(path: Path, real: np.ndarray, rendered: np.ndarray) -> None:
    """Write photograph, rendering and error, each (H, W, 3), as one PNG of three times the width."""
    strip = np.concatenate([real, rendered, error_colors(real, rendered)], axis=1)
    atomic_write_bytes(path, encode_png(strip))


def read_strip(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Photograph, rendering and error of a strip."""
    with Image.open(path) as image:
        strip = np.asarray(image.convert("RGB"))
    width = strip.shape[1] // 3
    return strip[:, :width], strip[:, width : 2 * width], strip[:, 2 * width :]


def enlarge(image: np.ndarray, factor: int) -> np.ndarray:
    """Every pixel as a square of `factor` pixels: nothing is smoothed away."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)
