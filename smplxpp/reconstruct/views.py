"""Hold the photographs, masks and cameras of one moment, and check whether they can determine a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

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
