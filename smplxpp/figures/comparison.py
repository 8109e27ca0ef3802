"""Pictures of a fit: photograph, rendering and error beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.image_file import open_image
from smplxpp.core.mesh import TriangleMesh
from smplxpp.figures.body_drawings import render_heat
from smplxpp.figures.colors import colormap, heat_colors
from smplxpp.figures.sheets import caption, encode_png, row
from smplxpp.metrics import point_to_surface
from smplxpp.raster import body_cameras

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


SURFACE_HEIGHT = 480
SURFACE_LIMIT_MM = 40.0
"""Distance that the colours of posed meshes end at."""


def write_tiles(path: Path, truth: UInt8[np.ndarray, "H W 3"], rendered: Sequence[UInt8[np.ndarray, "H W 3"]]) -> None:
    """Write photograph, renderings and the last one's error side by side as one PNG."""
    tiles = [truth, *rendered, error_colors(truth, rendered[-1])]
    atomic_write_bytes(path, encode_png(np.concatenate(tiles, axis=1)))


def read_tiles(path: Path, count: int) -> tuple[UInt8[np.ndarray, "H W 3"], list[UInt8[np.ndarray, "H W 3"]]]:
    """Read photograph and `count` renderings of a picture that `write_tiles` wrote."""
    strip = np.asarray(open_image(path, subject="picture").convert("RGB"))
    truth, *rendered, _ = np.split(strip, count + 2, axis=1)
    return truth, rendered


def surface_picture(truth: TriangleMesh, posed: Mapping[str, TriangleMesh]) -> UInt8[np.ndarray, "H W 3"]:
    """Draw each posed mesh from the front and the back, coloured by its distance to the truth."""
    cameras = body_cameras(truth, views=("front", "back"), height=SURFACE_HEIGHT)
    panels = []
    for name, mesh in posed.items():
        distance = 1e3 * point_to_surface(mesh.vertices, truth)[0]
        last = name == list(posed)[-1]
        pictures = [
            render_heat(
                mesh, camera, distance, limits=(0.0, SURFACE_LIMIT_MM), unit="mm", bar=last and camera is cameras[-1]
            )
            for camera in cameras
        ]
        panels.append(caption(row(pictures, gap=0), name))
    return row(panels)
