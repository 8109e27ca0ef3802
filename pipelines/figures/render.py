"""Draw pictures of a mesh coloured by a value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from pipelines.figures.colors import heat_colors
from pipelines.figures.sheets import color_bar
from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.core.colors import linear_from_srgb
from smplxpp.raster.shading import ShadeStyle, render_shaded, resolve, shade_layer


def render_heat(
    mesh: TriangleMesh,
    camera: Camera,
    values: Float[np.ndarray, " K"],
    *,
    cmap: str = "error",
    limits: tuple[float, float],
    unit: str = "",
    bar: bool = True,
    style: ShadeStyle | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a mesh coloured by values, one a vertex or one a face, with a colour bar on the right.

    Values outside `limits` take the end colours, values that are not finite are grey. Vertex values are interpolated
    after colouring, so a picture is exact at vertices only.
    """
    # Light and shadow are held back: the colour is the message.
    style = style or ShadeStyle(relief=0.55)
    values = np.asarray(values, dtype=np.float64)
    if values.shape not in ((mesh.vertex_count,), (mesh.face_count,)):
        raise InputError(
            "values of a heat map",
            expected=f"shape ({mesh.vertex_count},) or ({mesh.face_count},)",
            received=f"shape {values.shape}",
        )
    colors = heat_colors(values, cmap=cmap, limits=limits)
    key = "vertex_colors" if len(values) == mesh.vertex_count else "face_colors"
    picture = render_shaded(mesh, camera, style=replace(style), **{key: colors})
    if not bar:
        return picture
    side = color_bar(cmap=cmap, limits=limits, unit=unit, height=len(picture), background=style.background)
    return np.concatenate([picture, side], axis=1)


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
