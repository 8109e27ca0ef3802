"""Z-buffer rasterisation of meshes without a GPU or a screen, and what follows from it: visibility."""

from smplxpp.raster.visibility import outer_visible_faces, outer_visible_points, outside_views, view_directions
from smplxpp.raster.zbuffer import MeshMaps, rasterize_mesh, rasterize_triangles

__all__ = [
    "MeshMaps",
    "outer_visible_faces",
    "outer_visible_points",
    "outside_views",
    "rasterize_mesh",
    "rasterize_triangles",
    "view_directions",
]
