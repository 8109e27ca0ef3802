"""Turn masks into signed distance fields: how far inside its silhouette a view sees a point, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy import ndimage

from smplxpp.core.camera import Camera
from smplxpp.reconstruct.views import INSIDE, PhotoView

UNSEEN = np.float32(1e6)
"""Depth inside the silhouette of a view that does not show the point, metres; such a view has no vote."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The signed distance field of a mask, in a window around the mask.

    Attributes:
        name: of the view.
        camera: of the view.
        distance: distances of pixel centres to the outline, pixels, positive inside.
        corner: x and y of the window's first pixel.
        pixel: size of a pixel at a depth of one metre, metres.
        projection: homogeneous pixels from world coordinates.
    """

    name: str
    camera: Camera
    distance: Float32[np.ndarray, "h w"]
    corner: tuple[int, int]
    pixel: float
    projection: Float64[np.ndarray, "3 4"]

    @staticmethod
    def of(view: PhotoView) -> Silhouette:
        """Compute the silhouette of a view whose mask is neither empty nor full."""
        margin = 8  # pixels around the mask in which the distance is exact
        inside = view.opacity > INSIDE
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        y0, y1 = max(0, rows[0] - margin), min(len(inside), rows[-1] + 1 + margin)
        x0, x1 = max(0, columns[0] - margin), min(inside.shape[1], columns[-1] + 1 + margin)
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
        """Return the depth of points inside the silhouette's cone, metres; `UNSEEN` where the image ends."""
        # Project; points behind the camera or outside the image are not shown.
        m = self.projection.astype(np.float32)
        x, y, z = (points @ row[:3] + row[3] for row in m)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = x / z, y / z
            shown = (z > 0) & (x >= 0) & (y >= 0) & (x <= self.camera.width) & (y <= self.camera.height)
        x, y = np.where(shown, x, 0) - (self.corner[0] + 0.5), np.where(shown, y, 0) - (self.corner[1] + 0.5)
        # Bilinear interpolation in the window, clamped at its border.
        height, width = self.distance.shape
        u, v = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
        column, row = np.minimum(u.astype(np.int32), width - 2), np.minimum(v.astype(np.int32), height - 2)
        du, dv = u - column, v - row
        flat, first = self.distance.ravel(), row * width + column
        top = flat[first] + du * (flat[first + 1] - flat[first])
        bottom = flat[first + width] + du * (flat[first + width + 1] - flat[first + width])
        # Outside the window, the distance to the window is added.
        pixels = top + dv * (bottom - top) - np.hypot(x - u, y - v)
        return np.where(shown, pixels * np.maximum(z, 0) * np.float32(self.pixel), UNSEEN).astype(np.float32)


def signed_distance(opacity: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return the distances of pixel centres to the outline of an antialiased mask, pixels, positive inside.

    The coverage of a partly covered pixel gives the position of the outline in it. Other pixels add their distance to
    the nearest pixel of the other side or, where that is less, to the nearest partly covered one of their own side
    (after Gustavson and Strand 2011).
    """
    inside = opacity > INSIDE
    out = np.empty(opacity.shape, np.float32)
    for own, whole in ((inside, 255.0), (~inside, 0.0)):
        own_at_outline = own & (opacity != whole) & ndimage.binary_dilation(~own)
        sign = 1.0 if whole else -1.0
        found = [_by_nearest(opacity, there, sign) for there in (~own, own_at_outline) if there.any()]
        out = np.where(own, sign * np.min([sign * one for one in found], axis=0), out)
    return out.astype(np.float32)


def _by_nearest(opacity: np.ndarray, there: np.ndarray, sign: float) -> np.ndarray:
    """Return the signed distance to the outline as the nearest of the pixels `there` gives it."""
    distance, nearest = ndimage.distance_transform_edt(~there, return_indices=True)
    return sign * distance + (opacity[tuple(nearest)].astype(np.float32) / np.float32(255.0) - 0.5)


def least_shown(views: int) -> int:
    """Return the number of views that must show a point for it to count as inside: a quarter, and at least two."""
    return max(2, int(0.25 * views))


def smallest_depths(
    silhouettes: Sequence[Silhouette], points: Float32[np.ndarray, "N 3"], *, count: int = 1
) -> Float32[np.ndarray, "N count"]:
    """Return the `count` smallest depths of each point among the views, ascending; -`UNSEEN` if too few show it."""
    chunk = 1 << 18  # points at once, which bounds the memory
    out = np.empty((len(points), count), np.float32)
    least = least_shown(len(silhouettes))
    for first in range(0, len(points), chunk):
        part = points[first : first + chunk]
        smallest = np.full((len(part), count), UNSEEN, np.float32)
        shown = np.zeros(len(part), np.int32)
        for silhouette in silhouettes:
            depth = silhouette.depth(part)
            # A camera that does not show the point says nothing about it.
            shown += depth < UNSEEN
            if count == 1:
                np.minimum(smallest[:, 0], depth, out=smallest[:, 0])
            else:
                # Keep the running `count` smallest, so that memory does not grow with the number of views.
                both = np.concatenate([smallest, depth[:, None]], axis=1)
                smallest = np.sort(both, axis=1)[:, :count]
        out[first : first + chunk] = np.where((shown >= least)[:, None], smallest, -UNSEEN)
    return out
