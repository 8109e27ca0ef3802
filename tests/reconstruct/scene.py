"""A textured ball with a dent that no silhouette shows, seen by cameras all around."""

from __future__ import annotations

from functools import cache

import numpy as np

from smplxpp.core import Camera, TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct.hull import zero_surface
from smplxpp.reconstruct.views import Box, PhotoView

RADIUS = 0.5
BOX = Box(np.full(3, -0.6), np.full(3, 0.6))
DENT = np.array([0.0, 0.0, 1.0])
_DEEP, _WIDE = 0.08, 0.4


def inside_ball(points: np.ndarray) -> np.ndarray:
    """Metres inside a ball (float32)."""
    return (RADIUS - np.linalg.norm(points, axis=1)).astype(np.float32)


def inside_dented(points: np.ndarray) -> np.ndarray:
    """Metres inside a ball with a bowl pressed into its front."""
    length = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    angle = np.arccos(np.clip(points @ DENT / length, -1, 1))
    return (RADIUS - _DEEP * np.exp(-((angle / _WIDE) ** 2)) - length).astype(np.float32)


def texture(points: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] of points in space: waves of two centimetres to ten."""
    rng = np.random.default_rng(3)
    color = np.full((len(points), 3), 0.5)
    for wave in rng.uniform(60, 250, 12):
        direction = rng.normal(size=3)
        phase = points @ (wave * direction / np.linalg.norm(direction))
        color += 0.1 * np.sin(phase[:, None] + rng.uniform(0, 6, 3))
    return np.clip(color, 0, 1)


def ring(count: int = 14, *, size: int = 140) -> list[Camera]:
    """Cameras on three rings, looking at the middle."""
    cameras = []
    for k in range(count):
        angle, height = 2 * np.pi * k / count, (-0.7, 0.1, 0.9)[k % 3]
        eye = 2.2 * np.array([np.sin(angle), height, np.cos(angle)]) / np.hypot(1, height)
        cameras.append(Camera.look_at(eye=eye, target=np.zeros(3), fov_y_deg=34, width=size, height=size))
    return cameras


def photograph(mesh: TriangleMesh, camera: Camera, name: str, *, plain: bool = False, fine: int = 3) -> PhotoView:
    """A photograph and its antialiased mask."""
    large = camera.resized(fine * camera.width, fine * camera.height)
    maps = rasterize_mesh(mesh, large)
    color = np.zeros((*maps.mask.shape, 3))
    points = maps.interpolate(mesh.faces, mesh.vertices)[maps.mask]
    color[maps.mask] = 0.6 if plain else texture(points)
    shape = (camera.height, fine, camera.width, fine)
    covered = maps.mask.reshape(shape).mean(axis=(1, 3))
    mean = color.reshape(*shape, 3).sum(axis=(1, 3)) / np.maximum(covered * fine**2, 1)[..., None]
    return PhotoView(name, camera, np.round(255 * mean).astype(np.uint8), np.round(255 * covered).astype(np.uint8))


@cache
def dented_views(*, plain: bool = False, count: int = 14) -> tuple[PhotoView, ...]:
    """Photographs of the dented ball; plain ones for tests that look at masks alone."""
    mesh = zero_surface(inside_dented, BOX, cell=0.0125)
    return tuple(photograph(mesh, camera, f"cam{k:02d}", plain=plain) for k, camera in enumerate(ring(count)))


def few_views() -> tuple[PhotoView, ...]:
    """Ten of them, from the same three rings, which reconstruct it as well."""
    return dented_views(count=10)
