"""Draw pictures of meshes without a screen: shaded surfaces, heat maps, overlays, contact sheets, films.

Example:
    >>> camera = body_cameras(mesh, views=("front",))[0]
    >>> Path("scan.png").write_bytes(encode_png(render_shaded(mesh, camera, vertex_colors=colors)))
"""

from smplxpp.figures.colors import (
    blend_joint_colors,
    colormap,
    heat_colors,
    joint_palette,
)
from smplxpp.figures.drawings import body_on_photograph, draw_bones, draw_keypoints, render_heat
from smplxpp.figures.film import write_film
from smplxpp.figures.sheets import caption, color_bar, contact_sheet, encode_jpeg, encode_png, row
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
    "body_on_photograph",
    "caption",
    "color_bar",
    "colormap",
    "contact_sheet",
    "draw_bones",
    "draw_keypoints",
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
    "write_film",
]
