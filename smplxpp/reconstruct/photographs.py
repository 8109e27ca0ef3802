"""Photographs as the sweep and the colours look at them: levels of resolution, what each camera sees of a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from smplxpp.core.camera import Camera
from smplxpp.core.mesh import TriangleMesh, normalize_rows
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct.views import PhotoView

LEVELS = 4
_FULL = np.float32(255.0)
# How far behind the nearest surface a vertex may lie and count as seen: metres, and pixels of the surface's slope.
_BEHIND, _BEHIND_PIXELS = 2e-3, 1.5


@dataclass(frozen=True, eq=False)
class Pyramids:
    """All photographs at `LEVELS` resolutions, one after another.

    Attributes:
        values: red, green, blue, opacity in [0, 1] of every pixel.
        starts: (V, L) of each level in `values`. sizes: (V, L, 2) heights and widths.
        projections: (V, 3, 4) to full pixels.
        cameras: of the views.
    """

    values: Float32[np.ndarray, " N"]
    starts: Int64[np.ndarray, "V L"]
    sizes: Int32[np.ndarray, "V L 2"]
    projections: Float64[np.ndarray, "V 3 4"]
    cameras: tuple[Camera, ...]

    @staticmethod
    def of(views: Sequence[PhotoView]) -> Pyramids:
        """Halve every photograph as often as its size allows; the last level stands for those that it does not."""
        values, starts, sizes, start = [], [], [], 0
        for view in views:
            level = np.concatenate([view.color, view.opacity[..., None]], axis=2).astype(np.float32) / _FULL
            for _ in range(LEVELS):
                values.append(level.ravel())
                starts.append(start)
                sizes.append(level.shape[:2])
                start += level.size
                height, width = level.shape[0] // 2, level.shape[1] // 2
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


@dataclass(frozen=True, eq=False)
class Sight:
    """How cameras see the vertices of a surface.

    Attributes:
        cosine: of the angle between normal and view; 0 where something hides the vertex or it lies outside the image.
        pixel: metres that a pixel takes there.
    """

    cosine: Float32[np.ndarray, "N V"]
    pixel: Float32[np.ndarray, "N V"]

    def select(self, rows: Bool[np.ndarray, " N"]) -> Sight:
        """The sight of some of the vertices."""
        return Sight(self.cosine[rows], self.pixel[rows])

    def chosen(self, most: int, *, least_cosine: float) -> Int32[np.ndarray, "N most"]:
        """The views that look at a vertex most squarely; -1 where there are fewer."""
        most = min(most, self.cosine.shape[1])
        order = np.argsort(-self.cosine, axis=1, kind="stable")[:, :most].astype(np.int32)
        return np.where(np.take_along_axis(self.cosine, order, axis=1) > least_cosine, order, np.int32(-1))

    def seen(self, *, least_cosine: float = 0.2) -> Int64[np.ndarray, " N"]:
        """How many cameras see each vertex."""
        return (self.cosine > least_cosine).sum(axis=1)


def sight(mesh: TriangleMesh, normals: Float[np.ndarray, "N 3"], cameras: Sequence[Camera]) -> Sight:
    """Find what each camera sees of the vertices, by its z-buffer."""
    cosine = np.zeros((mesh.vertex_count, len(cameras)), np.float32)
    pixel = np.zeros_like(cosine)
    for k, camera in enumerate(cameras):
        screen = camera.screen_from_world(mesh.vertices)
        to_camera = normalize_rows(camera.position - mesh.vertices)
        facing = np.einsum("ij,ij->i", to_camera, normals)
        pixel[:, k] = np.abs(screen[:, 2]) * 2.0 / (camera.K[0, 0] + camera.K[1, 1])
        shown = _in_image(screen, camera) & (facing > 0)
        depth = rasterize_mesh(mesh, camera).depth
        column, row = screen[shown, 0].astype(np.int64), screen[shown, 1].astype(np.int64)
        behind = screen[shown, 2] - depth[row, column]
        slope = pixel[shown, k] / np.maximum(facing[shown], 0.1)
        visible = behind <= _BEHIND + _BEHIND_PIXELS * slope
        cosine[np.flatnonzero(shown)[visible], k] = facing[shown][visible]
    return Sight(cosine, pixel)


def _in_image(screen: Float64[np.ndarray, "N 4"], camera: Camera) -> Bool[np.ndarray, " N"]:
    x, y, z = screen[:, 0], screen[:, 1], screen[:, 2]
    return (z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
