"""Make cameras that frame a body, with one scale for all views of a row, so that pictures can be compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from smplxpp.core import Camera, InputError, TriangleMesh, require_known

# Directions from the body to the camera. The body stands along +y and faces +z; its left is +x.
VIEWS: dict[str, tuple[float, float, float]] = {
    "front": (0.0, 0.05, 1.0),
    "back": (0.0, 0.05, -1.0),
    "side": (1.0, 0.05, 0.0),
    "left": (1.0, 0.05, 0.0),
    "right": (-1.0, 0.05, 0.0),
    "three-quarter": (0.62, 0.12, 0.78),
    "three-quarter-back": (-0.62, 0.12, -0.78),
    "above": (0.0, 1.0, 0.35),
}
FIELD_OF_VIEW_DEG = 22.0
"""Vertical field of view: a long lens, with little perspective but still a sense of depth."""


def body_cameras(
    mesh: TriangleMesh, *, views: Sequence[str] = ("front", "side", "back"), height: int = 900, margin: float = 0.04
) -> list[Camera]:
    """Make a camera a view, `height` pixels high and as wide as the body needs; see `VIEWS` for the names."""
    require_known("view", views, VIEWS)
    used = mesh.vertices[np.unique(mesh.faces)]
    return fit_cameras(used, directions=[VIEWS[name] for name in views], names=views, height=height, margin=margin)


def turntable_cameras(
    points: Float[np.ndarray, "N 3"], *, count: int, height: int = 900, width: int | None = None
) -> list[Camera]:
    """Make `count` cameras on a circle about points, one turn from the front to the body's left and on."""
    angles = 2.0 * np.pi * np.arange(count) / max(count, 1)
    directions = np.stack([np.sin(angles), np.full(count, 0.08), np.cos(angles)], axis=1)
    return fit_cameras(points, directions=list(directions), height=height, width=width, common_width=True)


def fit_cameras(
    points: Float[np.ndarray, "N 3"],
    *,
    directions: Sequence[Float[np.ndarray, " 3"] | tuple[float, float, float]],
    names: Sequence[str] = (),
    height: int = 900,
    width: int | None = None,
    margin: float = 0.04,
    common_width: bool = False,
) -> list[Camera]:
    """Make perspective cameras that see all points along each of `directions`, from one common distance.

    Args:
        points: points to frame.
        directions: vectors from the points to the camera.
        names: names of the cameras.
        height: height of the pictures, pixels.
        width: width of the pictures, pixels; None makes each as wide as its points need.
        margin: free border, as a share of the height.
        common_width: without `width`, use the widest picture's width for all.

    The distance is the smallest at which |x| <= t_x (d + z) and |y| <= t_y (d + z) holds for every point in every
    view, with z the depth relative to the centre of the bounding box and t the tangents of half the field of view.
    """
    points = np.asarray(points, dtype=np.float64)
    if not len(points):
        raise InputError("points to frame", expected="at least one", received="none")
    low, high = points.min(axis=0), points.max(axis=0)
    center = 0.5 * (low + high)
    tan_y = np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2) * (1.0 - 2.0 * margin)
    tan_x = None if width is None else tan_y * (width / height - 2.0 * margin) / (1.0 - 2.0 * margin)
    # The smallest distance from which every view sees all points.
    bases = [_view_basis(np.asarray(d, dtype=np.float64)) for d in directions]
    local = [(points - center) @ basis.T for basis in bases]
    need = [np.max(np.abs(p[:, 1]) / tan_y - p[:, 2]) for p in local]
    if tan_x is not None:
        need += [np.max(np.abs(p[:, 0]) / tan_x - p[:, 2]) for p in local]
    distance = max(float(max(need)), 1e-3)
    # Focal length in pixels, and the widths of the pictures.
    focal = 0.5 * height / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)
    if width is not None:
        widths = [width] * len(bases)
    else:
        half = [focal * np.max(np.abs(p[:, 0]) / (distance + p[:, 2])) for p in local]
        widths = [2 * int(np.ceil(h + margin * height)) for h in half]
        if common_width:
            widths = [max(widths)] * len(bases)
    # All cameras look at the centre of the bounding box.
    cameras = []
    for k, (basis, w) in enumerate(zip(bases, widths, strict=True)):
        pose = np.eye(4)
        pose[:3, :3] = basis
        pose[:3, 3] = -basis @ center + [0.0, 0.0, distance]
        K = np.array([[focal, 0.0, w / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        cameras.append(Camera(K, pose, w, height, name=names[k] if k < len(names) else ""))
    return cameras


def _view_basis(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return rows: the camera's x (right), y (down) and z (forward) in the world, for a camera along `direction`."""
    z = -direction / np.linalg.norm(direction)
    up = np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.99 else np.array([0.0, 0.0, -1.0])
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
