"""Signed distances to a mask's contour, kept small: what silhouettes are compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int8, UInt8
from scipy.ndimage import distance_transform_edt

# Masks are reduced until they are at most so high; distances are kept to 1/4 of such a pixel, up to this many.
_HEIGHT = 800
_STEPS, _FARTHEST = 4.0, 31.0
_MARGIN = 24


@dataclass(frozen=True, eq=False)
class Outline:
    """Signed distances to the contour of one mask, negative inside.

    Attributes:
        field: quarters of a reduced pixel, of a window of the image. corner: x, y of the window's corner, in reduced
            pixels.
        factor: pixels of the image to a reduced one. width, height: of the reduced image.
    """

    field: Int8[np.ndarray, "h w"]
    corner: tuple[int, int]
    factor: int
    width: int
    height: int

    @staticmethod
    def of(mask: UInt8[np.ndarray, "H W"]) -> Outline | None:
        """The outline of a person's opacity; None where there is nobody."""
        factor = max(1, -(-mask.shape[0] // _HEIGHT))
        height, width = mask.shape[0] // factor, mask.shape[1] // factor
        alpha = mask[: height * factor, : width * factor].astype(np.float32) / 255.0
        if factor > 1:
            alpha = alpha.reshape(height, factor, width, factor).mean(axis=(1, 3))
        rows, columns = np.flatnonzero((alpha > 0.5).any(axis=1)), np.flatnonzero((alpha > 0.5).any(axis=0))
        if not len(rows):
            return None
        y0, y1 = max(rows[0] - _MARGIN, 0), min(rows[-1] + 1 + _MARGIN, height)
        x0, x1 = max(columns[0] - _MARGIN, 0), min(columns[-1] + 1 + _MARGIN, width)
        # A person who is cut off by the image's edge has no contour there: what is beyond is taken to go on inside.
        window = np.pad(alpha[y0:y1, x0:x1], _pads(x0, y0, x1, y1, width, height), mode="edge")
        inside = window > 0.5
        distance = np.where(inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5)
        mixed = (window > 0.02) & (window < 0.98) & (np.abs(distance) < 1.5)
        distance[mixed] = 0.5 - window[mixed]
        (top, _), (left, _) = _pads(x0, y0, x1, y1, width, height)
        field = np.round(np.clip(distance, -_FARTHEST, _FARTHEST) * _STEPS).astype(np.int8)
        return Outline(field, (int(x0) - left, int(y0) - top), factor, width, height)

    def sample(
        self, pixels: Float64[np.ndarray, "N 2"]
    ) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, "N 2"], np.ndarray]:
        """Signed distance of pixels of the full image, its gradient, and where it is known (in the window, near)."""
        place = pixels / self.factor - 0.5 - np.asarray(self.corner)
        h, w = self.field.shape
        known = (place > 0).all(axis=1) & (place[:, 0] < w - 1) & (place[:, 1] < h - 1)
        place = np.where(known[:, None], place, 0.0)
        column, row = np.minimum(place.astype(np.int64), np.array([w - 2, h - 2])).T
        x, y = place[:, 0] - column, place[:, 1] - row
        a, b = self.field[row, column] / _STEPS, self.field[row, column + 1] / _STEPS
        c, d = self.field[row + 1, column] / _STEPS, self.field[row + 1, column + 1] / _STEPS
        value = (a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y
        gradient = np.stack([(b - a) * (1 - y) + (d - c) * y, (c - a) * (1 - x) + (d - b) * x], axis=1)
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        known &= (np.abs(value) < _FARTHEST - 1) & (length[:, 0] > 0.5)
        return value * self.factor, gradient / np.maximum(length, 1e-9), known


def _pads(x0: int, y0: int, x1: int, y1: int, width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Pixels to go on with beyond the image's edge, where the window ends there."""
    pad = int(_FARTHEST) + 2
    return (pad * (y0 == 0), pad * (y1 == height)), (pad * (x0 == 0), pad * (x1 == width))
