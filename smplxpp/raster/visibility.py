"""Find the visible outer surface of a mesh: the part that some camera around it could see."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64

from smplxpp.core import Camera, TriangleMesh
from smplxpp.raster.zbuffer import rasterize_mesh


def view_directions(count: int) -> Float64[np.ndarray, "count 3"]:
    """Return `count` unit vectors spread evenly over the sphere (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), z, r * np.sin(angle)], axis=1)


def outside_views(mesh: TriangleMesh, *, views: int = 32, resolution: int = 640) -> list[Camera]:
    """Return square orthographic views of a whole mesh from directions spread over the sphere."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    radius = 0.5 * float(np.linalg.norm(high - low)) * 1.01
    return [
        Camera.orthographic_view(center=0.5 * (low + high), direction=d, half_extent=radius, size=resolution)
        for d in view_directions(views)
    ]


def outer_visible_faces(mesh: TriangleMesh, *, views: int = 32, resolution: int = 640) -> Bool[np.ndarray, " M"]:
    """Return the faces that own a pixel in at least one of `views` orthographic views from outside."""
    seen = np.zeros(mesh.face_count, dtype=bool)
    for camera in outside_views(mesh, views=views, resolution=resolution):
        ids = rasterize_mesh(mesh, camera).face_id
        seen[ids[ids >= 0]] = True
    return seen


def outer_visible_points(
    mesh: TriangleMesh, points: Float[np.ndarray, "P 3"], *, tolerance: float, views: int = 32, resolution: int = 640
) -> Bool[np.ndarray, " P"]:
    """Return the points that are visible from outside in at least one orthographic view.

    A point is visible in a view if it lies at most `tolerance` metres behind the mesh's depth at its pixel.
    """
    points = np.asarray(points, dtype=np.float64)
    seen = np.zeros(len(points), dtype=bool)
    for camera in outside_views(mesh, views=views, resolution=resolution):
        depth = rasterize_mesh(mesh, camera).depth
        # Project the points that no view has seen yet, and compare their depth with the mesh's at their pixel.
        todo = np.flatnonzero(~seen)
        x, y, z = camera.screen_from_world(points[todo]).T[:3]
        col, row = np.floor(x).astype(int), np.floor(y).astype(int)
        inside = (col >= 0) & (col < camera.width) & (row >= 0) & (row < camera.height)
        front = np.full(len(todo), -np.inf)
        front[inside] = depth[row[inside], col[inside]]
        # A background pixel is no evidence, because it may be at the rim of a face that hides the point.
        seen[todo] = (z <= front + tolerance) & np.isfinite(front)
    return seen
