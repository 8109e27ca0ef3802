"""Masks as fields of distance: how far inside its silhouette every view sees a point, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy import ndimage

from smplxpp.core.camera import Camera
from smplxpp.reconstruct.views import INSIDE, PhotoView

UNSEEN = np.float32(1e6)
"""Metres inside of a view that does not show the point: it has nothing to say."""
_CHUNK = 1 << 18
_MARGIN = 8  # pixels about the mask's box in which the distance is exact
_FULL = 255.0
_SHOWN = 0.25


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A mask's signed distance within the box that holds the mask.

    Attributes:
        name, camera: of the view.
        distance: pixels to the outline at pixel centres, positive inside.
        corner: x, y of the box's first pixel.
        pixel: metres that a pixel takes at a distance of one metre.
        projection: pixels from the world, homogeneous.
    """

    name: str
    camera: Camera
    distance: Float32[np.ndarray, "h w"]
    corner: tuple[int, int]
    pixel: float
    projection: Float64[np.ndarray, "3 4"]

    @staticmethod
    def of(view: PhotoView) -> Silhouette:
        """The silhouette of a view whose mask is neither empty nor full."""
        inside = view.opacity > INSIDE
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        y0, y1 = max(0, rows[0] - _MARGIN), min(len(inside), rows[-1] + 1 + _MARGIN)
        x0, x1 = max(0, columns[0] - _MARGIN), min(inside.shape[1], columns[-1] + 1 + _MARGIN)
        camera = view.camera
        return Silhouette(
            view.name,
            camera,
            signed_distance(view.opacity[y0:y1, x0:x1]),
            (int(x0), int(y0)),
            2.0 / float(camera.K[0, 0] + camera.K[1, 1]),
            camera.K @ camera.cam_from_world[:3],
        )

    def depth(self, points: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
        """Metres inside the silhouette's cone at (N, 3) points, `UNSEEN` where the image does not show them."""
        m = self.projection.astype(np.float32)
        x, y, z = (points @ row[:3] + row[3] for row in m)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = x / z, y / z
            shown = (z > 0) & (x >= 0) & (y >= 0) & (x <= self.camera.width) & (y <= self.camera.height)
        x, y = np.where(shown, x, 0) - (self.corner[0] + 0.5), np.where(shown, y, 0) - (self.corner[1] + 0.5)
        height, width = self.distance.shape
        u, v = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
        column, row = np.minimum(u.astype(np.int32), width - 2), np.minimum(v.astype(np.int32), height - 2)
        du, dv = u - column, v - row
        flat, first = self.distance.ravel(), row * width + column
        top = flat[first] + du * (flat[first + 1] - flat[first])
        bottom = flat[first + width] + du * (flat[first + width + 1] - flat[first + width])
        # Beyond the box it is farther by the way to the box.
        pixels = top + dv * (bottom - top) - np.hypot(x - u, y - v)
        return np.where(shown, pixels * np.maximum(z, 0) * np.float32(self.pixel), UNSEEN).astype(np.float32)


def signed_distance(opacity: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Pixels from pixel centres to the outline of an antialiased mask, positive inside.

    A pixel that is covered in part says where in it the outline lies. Others add their way to the nearest one of the
    other side or, where that makes them nearer to the outline, to the nearest covered in part of their own (after
    Gustavson and Strand 2011).
    """
    inside = opacity > INSIDE
    out = np.empty(opacity.shape, np.float32)
    for own, whole in ((inside, _FULL), (~inside, 0.0)):
        own_at_outline = own & (opacity != whole) & ndimage.binary_dilation(~own)
        sign = 1.0 if whole else -1.0
        found = [_by_nearest(opacity, there, sign) for there in (~own, own_at_outline) if there.any()]
        out = np.where(own, sign * np.min([sign * one for one in found], axis=0), out)
    return out.astype(np.float32)


def _by_nearest(opacity: np.ndarray, there: np.ndarray, sign: float) -> np.ndarray:
    """The signed distance that the nearest of the pixels `there` tells of."""
    distance, nearest = ndimage.distance_transform_edt(~there, return_indices=True)
    return sign * distance + (opacity[tuple(nearest)].astype(np.float32) / np.float32(_FULL) - 0.5)


def least_shown(views: int) -> int:
    """How many of the views have to show a point that is to count as inside: what none shows is not the person."""
    return max(2, int(_SHOWN * views))


def smallest_depths(
    silhouettes: Sequence[Silhouette], points: Float32[np.ndarray, "N 3"], *, count: int = 1
) -> Float32[np.ndarray, "N count"]:
    """The `count` smallest depths of each point among the views, ascending; far outside where too few show it."""
    out = np.empty((len(points), count), np.float32)
    least = least_shown(len(silhouettes))
    for first in range(0, len(points), _CHUNK):
        part = points[first : first + _CHUNK]
        smallest = np.full((len(part), count), UNSEEN, np.float32)
        shown = np.zeros(len(part), np.int32)
        for silhouette in silhouettes:
            depth = silhouette.depth(part)
            shown += depth < UNSEEN
            if count == 1:
                np.minimum(smallest[:, 0], depth, out=smallest[:, 0])
            else:
                both = np.concatenate([smallest, depth[:, None]], axis=1)
                smallest = np.sort(both, axis=1)[:, :count]
        out[first : first + _CHUNK] = np.where((shown >= least)[:, None], smallest, -UNSEEN)
    return out
