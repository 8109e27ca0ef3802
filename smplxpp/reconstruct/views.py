"""Hold the photographs, masks and cameras of one moment, and turn masks into signed distance fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy import ndimage

from smplxpp.core import Camera, InputError, TriangleMesh, normalize_rows
from smplxpp.core.errors import one_line
from smplxpp.raster import rasterize_mesh

INSIDE = 127.5
"""Opacity above which a pixel belongs to the person; 255 is opaque."""
LEAST_VIEWS = 4
"""Number of views that a reconstruction needs; the hull of fewer silhouettes is mostly air."""


@dataclass(frozen=True, eq=False)
class PhotoView:
    """A photograph with its camera and the person's mask.

    Attributes:
        name: of the view, for messages.
        camera: of the photograph.
        color: sRGB.
        opacity: of the person, 255 inside.
    """

    name: str
    camera: Camera
    color: UInt8[np.ndarray, "H W 3"]
    opacity: UInt8[np.ndarray, "H W"]

    __repr__ = one_line


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box in world coordinates.

    Attributes:
        low: corner of the smallest coordinates, metres.
        high: corner of the largest coordinates, metres.
    """

    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]

    __repr__ = one_line


def mask_fault(view: PhotoView) -> str:
    """Return what is wrong with a mask as text; "" if it may show a person."""
    # An inverted mask fills most of every side of the image; a close-up leaves some side free.
    least_pixels, most_border = 64, 0.6
    inside = view.opacity > INSIDE
    share = float(inside.mean())
    if inside.sum() < least_pixels:
        return "empty"
    if share == 1.0:
        return "full: every pixel counts as the person"
    sides = [float(side.mean()) for side in (inside[0], inside[-1], inside[:, 0], inside[:, -1])]
    if min(sides) > most_border:
        return f"of the background: {100 * share:.0f} % of the image, at least {100 * min(sides):.0f} % of every side"
    return ""


def usable_views(views: Sequence[PhotoView]) -> tuple[list[PhotoView], dict[str, str]]:
    """Return the views whose masks may show a person, and the faults of the others by name.

    Raises:
        InputError: fewer than four views, photographs or masks whose size differs from their camera's, or fewer than
            four masks that may show a person.
    """
    if len(views) < LEAST_VIEWS:
        raise InputError(
            "views to reconstruct from",
            expected=f"at least {LEAST_VIEWS} cameras with a photograph and a mask, from all around",
            received=f"{len(views)}",
            remedy="add cameras; from fewer a silhouette's cone stays open",
        )
    for view in views:
        size = (view.camera.height, view.camera.width)
        if view.opacity.shape != size or view.color.shape != (*size, 3):
            raise InputError(
                f"view {view.name}",
                expected=f"photograph and mask of {size[1]} x {size[0]} pixels, as the camera",
                received=f"{view.color.shape[1]} x {view.color.shape[0]} and {view.opacity.shape[1]} x "
                f"{view.opacity.shape[0]}",
            )
    faults = {view.name: fault for view in views if (fault := mask_fault(view))}
    good = [view for view in views if view.name not in faults]
    if len(good) < LEAST_VIEWS:
        inverted = sum(fault.startswith("of the background") for fault in faults.values())
        raise InputError(
            "masks to reconstruct from",
            expected=f"the person inside (255) in at least {LEAST_VIEWS} views",
            received="; ".join(f"{name}: {fault}" for name, fault in list(faults.items())[:4])
            + (f" and {len(faults) - 4} more" if len(faults) > 4 else ""),
            remedy="invert the masks: black is the background" if 2 * inverted > len(faults) else "make new masks",
        )
    return good, faults


def view_directions_from(center: Float64[np.ndarray, " 3"], cameras: Sequence[Camera]) -> Float64[np.ndarray, "V 3"]:
    """Return unit directions from a point to the cameras."""
    return normalize_rows(np.stack([camera.position for camera in cameras]) - center)


def check_spread(center: Float64[np.ndarray, " 3"], cameras: Sequence[Camera]) -> str:
    """Return a note about a side that no camera sees; "" if cameras stand all around.

    Raises:
        InputError: all cameras are on one side, so that the hull is open behind the person.
    """
    least_apart, wide_gap = 100.0, 150.0  # degrees
    to = view_directions_from(center, cameras)
    # Angle between the two most different viewing directions, from the smallest cosine.
    widest = float(np.degrees(np.arccos(np.clip((to @ to.T).min(), -1.0, 1.0))))
    if widest < least_apart:
        raise InputError(
            "cameras to reconstruct from",
            expected=f"views from all around: two directions at least {least_apart:.0f} degrees apart",
            received=f"{len(cameras)} cameras within {widest:.0f} degrees",
            remedy="add cameras behind the person, or hold fewer out (--hold-out)",
        )
    gap, toward = widest_gap(to)
    if gap <= wide_gap:
        return ""
    return (
        f"no camera stands within {gap / 2:.0f} degrees of the direction ({toward[0]:.2f}, 0, {toward[1]:.2f}): the "
        "surface there is the silhouettes' alone"
    )


def widest_gap(directions: Float64[np.ndarray, "V 3"]) -> tuple[float, tuple[float, float]]:
    """Return the widest angle about the vertical without a camera, degrees, and its middle direction (x, z)."""
    angles = np.sort(np.arctan2(directions[:, 0], directions[:, 2]))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    k = int(gaps.argmax())
    middle = angles[k] + gaps[k] / 2
    return float(np.degrees(gaps[k])), (float(np.sin(middle)), float(np.cos(middle)))


def silhouette_agreement(mesh: TriangleMesh, views: Sequence[PhotoView]) -> dict[str, float]:
    """Return the intersection over union of the surface's silhouette and the mask of each view; 0 if both are empty."""
    out = {}
    for view in views:
        drawn, mask = rasterize_mesh(mesh, view.camera).mask, view.opacity > INSIDE
        union = int((drawn | mask).sum())
        out[view.name] = float((drawn & mask).sum()) / union if union else 0.0
    return out


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
        block = 1 << 14  # points whose intermediate results the processor's cache holds
        m = self.projection.astype(np.float32)
        x, y, z = (points @ row[:3] + row[3] for row in m)
        out = np.empty(len(points), np.float32)
        for start in range(0, len(points), block):
            some = slice(start, start + block)
            out[some] = self._depth_on_screen(x[some], y[some], z[some])
        return out

    def _depth_on_screen(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Float32[np.ndarray, " N"]:
        """Return the depth of points from their homogeneous pixels."""
        # Points behind the camera or outside the image are not shown.
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
