"""Pictures of meshes without a screen: shaded surfaces, heat maps, overlays and contact sheets.

>>> camera = body_cameras(mesh, views=("front",))[0]
>>> Path("scan.png").write_bytes(encode_png(render_shaded(mesh, camera, vertex_colors=colors)))
"""

from pipelines.figures.body_drawings import render_heat
from pipelines.figures.colors import (
    blend_joint_colors,
    colormap,
    heat_colors,
    joint_palette,
)
from pipelines.figures.sheets import caption, color_bar, contact_sheet, encode_jpeg, encode_png, row
from smplxpp.raster import (
    VIEWS,
    ShadeStyle,
    body_cameras,
    fit_cameras,
    render_overlay,
    render_shaded,
    turntable_cameras,
)

__all__ = [
    "VIEWS",
    "ShadeStyle",
    "blend_joint_colors",
    "body_cameras",
    "caption",
    "color_bar",
    "colormap",
    "contact_sheet",
    "encode_jpeg",
    "encode_png",
    "fit_cameras",
    "heat_colors",
    "joint_palette",
    "render_heat",
    "render_overlay",
    "render_shaded",
    "row",
    "turntable_cameras",
]
