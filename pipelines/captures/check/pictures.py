"""Contact sheet: images with the outlines of mask and posed body."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from scipy import ndimage

from pipelines.figures import caption, contact_sheet, row
from smplxpp.capture.check.check import CaptureCheck
from smplxpp.capture.check.silhouettes import body_silhouette
from smplxpp.capture.check.views import OPAQUE, ViewCheck
from smplxpp.core.errors import InputError
from smplxpp.core.spread import spread

BODY_COLOR, MASK_COLOR = (255, 60, 140), (0, 210, 255)
_CELL_HEIGHT, _CAPTION_WIDTH = 300, 190
_MOST_CAMERAS, _MOST_FRAMES = 24, 4


def draw_strips(check: CaptureCheck) -> dict[str, UInt8[np.ndarray, "_ _ 3"]]:
    """Draw for each camera a few frames beside each other; of many cameras some, evenly spread."""
    frames = spread(check.frames, _MOST_FRAMES)
    known = {(view.camera, view.frame): view for view in check.views}
    strips = {}
    for camera in spread(list(dict.fromkeys(view.camera for view in check.views)), _MOST_CAMERAS):
        cells = [
            caption(_widened(_cell(check, camera, frame)), _words(known.get((camera, frame)), camera, frame), size=13)
            for frame in frames
        ]
        strips[camera] = row(cells, gap=8)
    return strips


def contact_sheet_of(strips: dict[str, UInt8[np.ndarray, "_ _ 3"]]) -> UInt8[np.ndarray, "H W 3"]:
    """Put all strips into one picture, several beside each other where there are many."""
    return contact_sheet(list(strips.values()), columns=max(1, round(len(strips) ** 0.5 / 2)), gap=8)


def _widened(cell: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H w 3"]:
    """Put a cell on white, wide enough for its caption."""
    missing = max(0, _CAPTION_WIDTH - cell.shape[1])
    return np.pad(cell, ((0, 0), (missing // 2, missing - missing // 2), (0, 0)), constant_values=255)


def _cell(check: CaptureCheck, camera: str, frame: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw one view with both outlines at the sheet's height."""
    small, full = check.small, check.small.cameras[camera]
    try:
        image = np.array(small.image(camera, frame))
        mask = small.mask(camera, frame)
    except InputError:
        image, mask = np.full((full.height, full.width, 3), 190, np.uint8), None
    height = min(_CELL_HEIGHT, full.height)
    size = (max(1, round(full.width * height / full.height)), height)
    cell = np.array(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))
    outlines = [] if mask is None else [(mask > OPAQUE, MASK_COLOR)]
    vertices = check.vertices(frame)
    if vertices is not None:
        outlines.append((body_silhouette(vertices, check.faces, full), BODY_COLOR))
    for shape, color in outlines:
        reduced = np.array(Image.fromarray(shape).resize(size, Image.Resampling.NEAREST))
        cell[reduced & ~ndimage.binary_erosion(reduced, border_value=1)] = color
    return cell


def _words(view: ViewCheck | None, camera: str, frame: int) -> str:
    if view is None:
        return f"{camera}, {frame}: no image"
    return f"{camera}, {frame}" + (f": {view.fit.outside:.1%} outside" if view.fit else "")
