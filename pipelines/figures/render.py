"""Draw pictures of a mesh coloured by a value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from pipelines.figures.colors import heat_colors
from pipelines.figures.sheets import color_bar
from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.raster.shading import ShadeStyle, render_shaded


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
