"""Rasterise meshes into maps of face, barycentric coordinates and depth, and find the surface that cameras can see."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, Integer, Num

from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.core.errors import one_line
from smplxpp.native import address, check_size, native_library, thread_count


@dataclass(frozen=True)
class MeshMaps:
    """Maps of the faces that a camera sees of a mesh.

    Attributes:
        face_id: (H, W) int32, -1 on the background.
        barycentric: (H, W, 3) float32 weights of the face's three corners (perspective-correct).
        depth: (H, W) float32, metres along the camera's z axis, inf on the background.
    """

    face_id: Int32[np.ndarray, "H W"]
    barycentric: Float32[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]

    __repr__ = one_line

    @property
    def mask(self) -> Bool[np.ndarray, "H W"]:
        """Return the pixels that the mesh covers."""
        return self.face_id >= 0

    def interpolate(
        self, faces: Integer[np.ndarray, "M 3"], vertex_values: Num[np.ndarray, "N D"], background: float = 0.0
    ) -> Float64[np.ndarray, "H W D"]:
        """Interpolate vertex values (N, D) at every pixel: (H, W, D) float64, `background` where nothing is hit."""
        values = np.asarray(vertex_values)
        out = np.full((*self.face_id.shape, values.shape[1]), background, dtype=np.float64)
        hit = self.mask
        corners = faces[self.face_id[hit]]
        out[hit] = np.einsum("pk,pkd->pd", self.barycentric[hit], values[corners])
        return out


def rasterize_mesh(mesh: TriangleMesh, camera: Camera, *, near: float = 1e-3, threads: int | None = None) -> MeshMaps:
    """Rasterise `mesh` through `camera` with a z-buffer; both sides of every face are drawn.

    A face with a corner nearer than `near` metres is skipped as a whole. The result is the same for any number of
    `threads` (None: up to 8).

    Raises:
        InputError: `near` is not finite, `threads` below 1, an image with more than 65536 pixels a side.
    """
    return _rasterize(mesh.vertices, mesh.faces, camera, near, threads)


def rasterize_triangles(
    vertices: Float[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "M 3"],
    camera: Camera,
    *,
    near: float = 1e-3,
    threads: int | None = None,
) -> MeshMaps:
    """Rasterise arrays as `rasterize_mesh` does a mesh; a face with a corner that is not finite is left out.

    Raises:
        InputError: as `rasterize_mesh`; other shapes or types; faces with indices of no vertex.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    # Shapes, types and indices are checked, because the native code trusts them.
    for name, array, kinds in (("vertices", vertices, "fiu"), ("faces", faces, "iu")):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in kinds:
            raise InputError(
                f"mesh {name}",
                expected=f"{'numbers' if name == 'vertices' else 'integers'} of shape (N, 3)",
                received=f"{array.dtype} of shape {array.shape}",
            )
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(
            "mesh faces",
            expected=f"indices in [0, {len(vertices)})",
            received=f"indices in [{faces.min()}, {faces.max()}]",
        )
    return _rasterize(vertices, faces, camera, near, threads)


def _rasterize(vertices: np.ndarray, faces: np.ndarray, camera: Camera, near: float, threads: int | None) -> MeshMaps:
    # Project to pixels in float64; the native z-buffer fills the maps.
    if not math.isfinite(near):
        raise InputError("near", expected="a finite distance in metres", received=repr(near))
    threads = thread_count(threads)
    check_size(camera.width, camera.height, f"camera {camera.name!r}: image size")
    # Columns are x and y in pixels and the depth in metres; parallel views have no near plane.
    screen = np.ascontiguousarray(camera.screen_from_world(vertices), dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    height, width = camera.height, camera.width
    face_id = np.empty((height, width), np.int32)
    barycentric = np.empty((height, width, 3), np.float32)
    depth = np.empty((height, width), np.float32)
    native_library().smplxpp_zbuffer(
        address(screen, "float64"),
        address(faces, "int32"),
        ctypes.c_int64(len(faces)),
        ctypes.c_double(near if not camera.orthographic else -np.inf),
        width,
        height,
        address(face_id, "int32"),
        address(barycentric),
        address(depth),
        threads,
    )
    return MeshMaps(face_id, barycentric, depth)


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


def _outside_depths(
    mesh: TriangleMesh, *, views: int, resolution: int
) -> Iterable[tuple[Camera, Float32[np.ndarray, "H W"]]]:
    """Yield the views of a mesh from outside with its depth in each."""
    for camera in outside_views(mesh, views=views, resolution=resolution):
        yield camera, rasterize_mesh(mesh, camera).depth


def outer_visible_points(
    mesh: TriangleMesh, points: Float[np.ndarray, "P 3"], *, tolerance: float, views: int = 32, resolution: int = 640
) -> Bool[np.ndarray, " P"]:
    """Return the points that are visible from outside in at least one orthographic view.

    A point is visible in a view if it lies at most `tolerance` metres behind the mesh's depth at its pixel.
    """
    points = np.asarray(points, dtype=np.float64)
    seen = np.zeros(len(points), dtype=bool)
    for camera, depth in _outside_depths(mesh, views=views, resolution=resolution):
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


def hiding_parts(
    mesh: TriangleMesh, part: Int64[np.ndarray, " M"], *, views: int = 32, resolution: int = 640
) -> Int64[np.ndarray, " M"]:
    """Return for each face of part 0 the part that hides it from outside; 0 for one that shows, and for other parts.

    A face is hidden if other parts lie before its centre in more than 0.7 of the views that part 0 alone would show it
    in; of these parts it is the most frequent. Views are at most 30 degrees from level (+Y up), because from below a
    skirt hides nothing.

    Example:
        >>> outer = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]])
        >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> both = TriangleMesh(np.concatenate([0.2 * outer, outer]), np.concatenate([faces, faces + 4]))
        >>> hiding_parts(both, np.repeat([0, 1], 4)).tolist()
        [1, 1, 1, 1, 0, 0, 0, 0]
    """
    tolerance, least_hidden = 0.005, 0.7  # metres behind the z-buffer of part 0; share of the views
    own = np.flatnonzero(part == 0)
    out, alone = np.zeros(mesh.face_count, dtype=np.int64), np.zeros(len(own))
    before = np.zeros((len(own), int(part.max(initial=0)) + 1))
    centers = mesh.face_centers[own]
    skin = TriangleMesh(mesh.vertices, mesh.faces[own])
    level = np.abs(view_directions(views)[:, 1]) <= 0.5
    cameras = outside_views(mesh, views=views, resolution=resolution) if len(own) else []
    for camera in (one for one, chosen in zip(cameras, level, strict=False) if chosen):
        # The centres that part 0 alone shows, and the part of the nearest face at their pixels.
        x, y, z = camera.screen_from_world(centers).T[:3]
        at = np.floor(y).astype(int), np.floor(x).astype(int)
        depth, ids = rasterize_mesh(skin, camera).depth[at], rasterize_mesh(mesh, camera).face_id[at]
        shown = np.flatnonzero(np.isfinite(depth) & (z <= depth + tolerance) & (ids >= 0))
        alone[shown] += 1
        before[shown, part[ids[shown]]] += 1
    hidden = (alone > 0) & (before[:, 0] < (1.0 - least_hidden) * alone)
    before[:, 0] = -1.0
    out[own[hidden]] = before[hidden].argmax(axis=1)
    return out
