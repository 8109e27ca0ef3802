"""Make cameras that frame a body, and draw one mesh as glass over another through them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from smplxpp.core import Camera, InputError, TriangleMesh, require_known
from smplxpp.core.colors import linear_from_srgb
from smplxpp.raster.shading import ShadeStyle, render_shaded, resolve, shade_layer

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


def render_overlay(
    solid: TriangleMesh,
    ghost: TriangleMesh,
    camera: Camera,
    *,
    solid_colors: UInt8[np.ndarray, "N 3"] | None = None,
    ghost_color: tuple[int, int, int] = (52, 128, 214),
    opacity: float = 0.30,
    style: ShadeStyle | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw `ghost` as tinted glass over and around `solid`.

    Where the ghost lies in front it tints the solid, most at its rim, where a thin shell is thickest along the view;
    where it lies behind, it is hidden. So a solid that sticks out of the ghost keeps its own colour.

    Args:
        solid_colors: sRGB of the solid's vertices.
        opacity: of the ghost where it faces the camera, 0 to 1.
    """
    style = style or ShadeStyle()
    # Shade both layers apart, in linear light. Occlusion would darken the ghost by its own folds, so it is off there.
    back = shade_layer(solid, camera, vertex_colors=solid_colors, style=style)
    front = shade_layer(ghost, camera, style=ShadeStyle(**{**vars(style), "base_color": ghost_color, "occlusion": 0.0}))
    tint = linear_from_srgb(np.array(ghost_color, np.uint8))
    # Opacity rises to 1 at the rim by Schlick's form (1 - cos)^5 with exponent 3, and only where the ghost is
    # nearer than the solid.
    alpha = (opacity + (1.0 - opacity) * (1.0 - front.facing) ** 3) * (front.mask & (front.depth < back.depth))
    # Composite ghost over solid (Porter and Duff's "over"): C = a F + (1 - a) B, for colour and coverage alike.
    over = alpha[..., None] * (0.5 * front.color + 0.5 * tint)
    color = over + (1.0 - alpha[..., None]) * back.color
    coverage = alpha + (1.0 - alpha) * back.mask
    return resolve(color, coverage, style=style)


def render_within(
    body: TriangleMesh,
    scan: TriangleMesh,
    *,
    facing: float = 0.0,
    colors: UInt8[np.ndarray, "N 3"] | None = None,
    height: int = 720,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a scan from the front of the body, and the body within it from the front and from the side, in a row.

    Args:
        body: posed.
        scan: the surface around it.
        facing: angle of the body's front about +Y from +Z, radians.
        colors: sRGB of the scan's vertices; None: grey.
        height: of the picture, pixels.
    """
    turn = np.array([[np.cos(facing), 0.0, np.sin(facing)], [0.0, 1.0, 0.0], [-np.sin(facing), 0.0, np.cos(facing)]])
    used = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in (scan, body)])
    directions = [turn @ np.array(VIEWS[name]) for name in ("front", "side")]
    front, side = fit_cameras(used, directions=directions, height=height)
    alone = render_shaded(scan, front, vertex_colors=colors)
    return np.concatenate([alone, render_overlay(body, scan, front), render_overlay(body, scan, side)], axis=1)
