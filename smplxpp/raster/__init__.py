"""Rasterise meshes into a z-buffer without a GPU or a screen, and find visibility and draw shaded pictures from it."""

from smplxpp.raster.shading import ShadeStyle, render_shaded
from smplxpp.raster.viewpoints import VIEWS, body_cameras, fit_cameras, render_overlay, render_within, turntable_cameras
from smplxpp.raster.zbuffer import (
    MeshMaps,
    hiding_parts,
    outer_visible_faces,
    outer_visible_points,
    outside_views,
    rasterize_mesh,
    rasterize_triangles,
    view_directions,
)

__all__ = [
    "VIEWS",
    "MeshMaps",
    "ShadeStyle",
    "body_cameras",
    "fit_cameras",
    "hiding_parts",
    "outer_visible_faces",
    "outer_visible_points",
    "outside_views",
    "rasterize_mesh",
    "rasterize_triangles",
    "render_overlay",
    "render_shaded",
    "render_within",
    "turntable_cameras",
    "view_directions",
]
