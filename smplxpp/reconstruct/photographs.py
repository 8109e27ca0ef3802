"""Prepare photographs for sampling: image pyramids, and the visibility of a surface's vertices in each camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from smplxpp.core import Camera, TriangleMesh, normalize_rows
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct.views import PhotoView

LEVELS = 4
"""Resolutions of a pyramid, each half of the one before."""


@dataclass(frozen=True, eq=False)
class Pyramids:
    """The image pyramids of all photographs, concatenated.

    Attributes:
        values: red, green, blue and opacity of every pixel, in [0, 1].
        starts: (V, L) offset of each level in `values`.
        sizes: (V, L, 2) height and width of each level.
        projections: (V, 3, 4) world coordinates to pixels of the full resolution.
        cameras: of the views.
    """

    values: Float32[np.ndarray, " N"]
    starts: Int64[np.ndarray, "V L"]
    sizes: Int32[np.ndarray, "V L 2"]
    projections: Float64[np.ndarray, "V 3 4"]
    cameras: tuple[Camera, ...]

    @staticmethod
    def of(views: Sequence[PhotoView]) -> Pyramids:
        """Halve every photograph as often as its size allows; smaller levels repeat the last one."""
        values, starts, sizes, start = [], [], [], 0
        for view in views:
            level = np.concatenate([view.color, view.opacity[..., None]], axis=2).astype(np.float32) / np.float32(255.0)
            for _ in range(LEVELS):
                values.append(level.ravel())
                starts.append(start)
                sizes.append(level.shape[:2])
                start += level.size
                height, width = level.shape[0] // 2, level.shape[1] // 2
                # A mean of 2 x 2 blocks; an odd last row or column is dropped.
                if min(height, width) >= 2:
                    even = level[: 2 * height, : 2 * width]
                    level = even.reshape(height, 2, width, 2, 4).mean(axis=(1, 3))
        shape = (len(views), LEVELS)
        return Pyramids(
            np.concatenate(values),
            np.array(starts, np.int64).reshape(shape),
            np.array(sizes, np.int32).reshape(*shape, 2),
            np.stack([view.camera.K @ view.camera.cam_from_world[:3] for view in views]),
            tuple(view.camera for view in views),
        )

    def sight(self, mesh: TriangleMesh, normals: Float[np.ndarray, "N 3"]) -> Sight:
        """Compute which vertices of a surface each view sees."""
        return sight(mesh, normals, self.cameras)

    def screen(self, view: int, points: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
        """Project points of the surface into a view."""
        return self.cameras[view].screen_from_world(points)

    def projections_of(
        self, points: Float64[np.ndarray, "N 3"]
    ) -> list[tuple[Int64[np.ndarray, " _"], Float64[np.ndarray, "V 3 4"]]]:
        """Group points by the projections of all views that hold near them: rows, and one projection a view."""
        return [(np.arange(len(points)), self.projections)]


@dataclass(frozen=True, eq=False)
class Sight:
    """The visibility of a surface's vertices in V cameras.

    Attributes:
        cosine: of the angle between normal and ray; 0 if the vertex is hidden or outside the image.
        pixel: size of a pixel at the vertex, metres.
    """

    cosine: Float32[np.ndarray, "N V"]
    pixel: Float32[np.ndarray, "N V"]

    def select(self, rows: Bool[np.ndarray, " N"]) -> Sight:
        """Return the visibility of some of the vertices."""
        return Sight(self.cosine[rows], self.pixel[rows])

    def chosen(self, most: int, *, least_cosine: float) -> Int32[np.ndarray, "N most"]:
        """Return the views of largest cosine for each vertex; -1 where there are fewer."""
        most = min(most, self.cosine.shape[1])
        order = np.argsort(-self.cosine, axis=1, kind="stable")[:, :most].astype(np.int32)
        return np.where(np.take_along_axis(self.cosine, order, axis=1) > least_cosine, order, np.int32(-1))

    def seen(self, *, least_cosine: float = 0.2) -> Int64[np.ndarray, " N"]:
        """Return the number of cameras that see each vertex."""
        return (self.cosine > least_cosine).sum(axis=1)


def sight(mesh: TriangleMesh, normals: Float[np.ndarray, "N 3"], cameras: Sequence[Camera]) -> Sight:
    """Compute which vertices each camera sees, by its z-buffer.

    A vertex may lie 2 mm and 1.5 pixels of the surface's slope behind the z-buffer, because the depth of a pixel is
    that of its centre.
    """
    columns = [sight_of_camera(mesh, normals, camera) for camera in cameras]
    cosine, pixel = (np.stack([column[part] for column in columns], axis=1) for part in (0, 1))
    return Sight(cosine, pixel)


def sight_of_camera(
    mesh: TriangleMesh, normals: Float[np.ndarray, "N 3"], camera: Camera
) -> tuple[Float32[np.ndarray, " N"], Float32[np.ndarray, " N"]]:
    """Return the cosine at each vertex, 0 where it is hidden, and the size of a pixel there (`Sight`)."""
    cosine = np.zeros(mesh.vertex_count, np.float32)
    screen = camera.screen_from_world(mesh.vertices)
    to_camera = normalize_rows(camera.position - mesh.vertices)
    facing = np.einsum("ij,ij->i", to_camera, normals)
    pixel = (np.abs(screen[:, 2]) * 2.0 / (camera.K[0, 0] + camera.K[1, 1])).astype(np.float32)
    # Visible: in the image, facing the camera, and not behind the z-buffer.
    shown = _in_image(screen, camera) & (facing > 0)
    depth = rasterize_mesh(mesh, camera).depth
    column, row = screen[shown, 0].astype(np.int64), screen[shown, 1].astype(np.int64)
    behind = screen[shown, 2] - depth[row, column]
    slope = pixel[shown] / np.maximum(facing[shown], 0.1)
    visible = behind <= 2e-3 + 1.5 * slope
    cosine[np.flatnonzero(shown)[visible]] = facing[shown][visible]
    return cosine, pixel


def _in_image(screen: Float64[np.ndarray, "N 4"], camera: Camera) -> Bool[np.ndarray, " N"]:
    """Return which projected points lie in the image and in front of the camera."""
    x, y, z = screen[:, 0], screen[:, 1], screen[:, 2]
    return (z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
