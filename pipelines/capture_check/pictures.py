"""Contact sheet: images with the outlines of mask and posed body."""

from __future__ import annotations

import numpy as np
from PIL import Image
from scipy import ndimage

from pipelines.capture_check.calibration import spread
from pipelines.capture_check.check import CaptureCheck
from pipelines.capture_check.silhouettes import body_silhouette
from pipelines.capture_check.views import OPAQUE, ViewCheck
from pipelines.pictures import caption, contact_sheet
from smplxpp.core.errors import InputError

BODY_COLOR, MASK_COLOR = (255, 60, 140), (0, 210, 255)
_CELL_HEIGHT, _CAPTION_WIDTH = 300, 190
_MOST_CAMERAS, _MOST_FRAMES = 24, 4


def draw_contact_sheet(check: CaptureCheck) -> np.ndarray | None:
    """(H, W, 3) uint8: a few frames of each camera beside each other; None without any image."""
    frames = spread(check.frames, _MOST_FRAMES)
    cameras = spread(list(dict.fromkeys(view.camera for view in check.views)), _MOST_CAMERAS)
    if not frames or not cameras:
        return None
    known = {(view.camera, view.frame): view for view in check.views}
    cells, captions = [], []
    for camera in cameras:
        for frame in frames:
            cells.append(_cell(check, camera, frame))
            captions.append(_words(known.get((camera, frame)), camera, frame))
    named = [caption(_widened(cell), words, size=13) for cell, words in zip(cells, captions, strict=True)]
    # Several cameras side by side, so that the sheet is about as wide as it is high.
    beside = max(1, round(len(cameras) ** 0.5 / 2))
    return contact_sheet(named, columns=len(frames) * beside, gap=8)


def _widened(cell: np.ndarray) -> np.ndarray:
    """On white, wide enough for the caption."""
    missing = max(0, _CAPTION_WIDTH - cell.shape[1])
    return np.pad(cell, ((0, 0), (missing // 2, missing - missing // 2), (0, 0)), constant_values=255)


def _cell(check: CaptureCheck, camera: str, frame: int) -> np.ndarray:
    """One view at the sheet's height."""
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
