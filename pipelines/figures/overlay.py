"""Two surfaces in one picture: one solid, the other as a ghost over it."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from smplxpp.core.camera import Camera
from smplxpp.core.colors import linear_from_srgb
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster.shading import ShadeStyle, resolve, shade_layer


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
    back = shade_layer(solid, camera, vertex_colors=solid_colors, style=style)
    front = shade_layer(ghost, camera, style=ShadeStyle(**{**vars(style), "base_color": ghost_color, "occlusion": 0.0}))
    tint = linear_from_srgb(np.array(ghost_color, np.uint8))
    alpha = (opacity + (1.0 - opacity) * (1.0 - front.facing) ** 3) * (front.mask & (front.depth < back.depth))
    over = alpha[..., None] * (0.5 * front.color + 0.5 * tint)
    color = over + (1.0 - alpha[..., None]) * back.color
    coverage = alpha + (1.0 - alpha) * back.mask
    return resolve(color, coverage, style=style)
