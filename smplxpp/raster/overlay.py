"""Draw a mesh as glass over another, for a body within the scan in which it was found."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from smplxpp.core import Camera, TriangleMesh
from smplxpp.core.colors import linear_from_srgb
from smplxpp.raster.shading import ShadeStyle, render_shaded, resolve, shade_layer
from smplxpp.raster.viewpoints import VIEWS, fit_cameras


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
