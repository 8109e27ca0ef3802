"""From files to the arrays that a capture gives out: decoded, checked, cut and resampled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smplxpp.capture.images import check_size, read_alpha, read_color, read_labels, read_normals
from smplxpp.capture.window import Window
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError

# Median difference, of 255, between the declared background and the pixels without any opacity: JPEG's is about 1.
_BACKGROUND_TOLERANCE = 16


def color(path: Path, camera: Camera, window: Window) -> np.ndarray:
    """(H, W, 3) uint8."""
    return np.array(window.apply(_sized(read_color(path), path, camera)))


def alpha(path: Path, camera: Camera, window: Window) -> np.ndarray:
    """(H, W) uint8."""
    return np.array(window.apply(_sized(read_alpha(path), path, camera)))


def labels(path: Path, camera: Camera, window: Window) -> np.ndarray:
    """(H, W) uint8."""
    return np.array(window.apply(_sized(read_labels(path), path, camera), labels=True))


def normals(path: Path, camera: Camera, window: Window) -> np.ndarray:
    """(H, W, 3) float32. Taken from the nearest pixel, as labels: an average over an edge is no normal."""
    from PIL import Image

    value = read_normals(path)
    channels = [Image.fromarray(np.ascontiguousarray(value[..., k])) for k in range(3)]
    return np.stack([np.asarray(window.apply(_sized(c, path, camera), labels=True)) for c in channels], axis=-1)


def foreground(
    image_path: Path, mask_path: Path, background: tuple[float, float, float] | None, camera: Camera, window: Window
) -> tuple[np.ndarray, np.ndarray]:
    """Colour times opacity (H, W, 3) uint8 and opacity (H, W) uint8.

    The product is formed on the full image: resampled apart, a photograph's background would bleed into the edges.
    """
    from PIL import Image

    image = _sized(read_color(image_path), image_path, camera)
    opacity = _sized(read_alpha(mask_path), mask_path, camera)
    if background is None:
        image = Image.composite(image, Image.new("RGB", image.size), opacity)
    else:
        _check_background(image, opacity, background, image_path)
        if any(background):
            share = 1.0 - np.asarray(opacity, dtype=np.float32)[..., None] / 255.0
            colour = np.asarray(background, dtype=np.float32) * 255.0
            image = Image.fromarray(np.clip(np.asarray(image) - share * colour + 0.5, 0, 255).astype(np.uint8))
    return np.array(window.apply(image)), np.array(window.apply(opacity))


def _sized(image, path: Path, camera: Camera):
    return check_size(image, path, (camera.width, camera.height), of=f"the size of camera {camera.name}")


def _check_background(image, opacity, background: tuple[float, float, float], path: Path) -> None:
    """An image that is not on the declared colour would be composited wrong without a sign of it."""
    # Every fourth pixel each way is enough for a median.
    outside = np.asarray(image)[::4, ::4][np.asarray(opacity)[::4, ::4] == 0]
    if not len(outside):
        return
    found = np.median(outside, axis=0)
    declared = np.asarray(background) * 255.0
    if np.abs(found - declared).max() > _BACKGROUND_TOLERANCE:
        raise InputError(
            f"image file {path}",
            expected=f"an image composited on RGB {declared.round().astype(int).tolist()}, as the capture declares",
            received=f"RGB {found.astype(int).tolist()} outside the mask",
            remedy='photographs are declared with `"background": null` in capture.json',
        )
