"""Pictures of an evaluation: photograph, models and errors side by side; distances on posed meshes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from pipelines.figures import body_cameras, caption, encode_png, render_heat, row
from pipelines.figures.comparison import error_colors
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.image_file import open_image
from smplxpp.core.mesh import TriangleMesh
from smplxpp.metrics import point_to_surface

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
