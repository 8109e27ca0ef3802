"""A known scene: the open body in two poses before a few cameras, drawn with a z-buffer, with or without a lens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from smplxpp.body import load_body
from smplxpp.core import BodyParams, Camera, TriangleMesh
from smplxpp.raster import rasterize_mesh

WIDTH, HEIGHT = 192, 256
# k1, k2, p1, p2, k3 in OpenCV's order: a strong wide-angle lens.
LENS = (-0.22, 0.06, 0.004, -0.003, 0.01)
SKIN, ROOM = np.array([210, 140, 90]), np.array([40, 90, 160])


@dataclass(frozen=True)
class Scene:
    """Cameras by name (undistorted), parameters and meshes of the frames, images and masks by (camera, frame)."""

    cameras: dict[str, Camera]
    lens: tuple[float, ...] | None
    params: BodyParams
    meshes: dict[int, TriangleMesh]
    photographs: dict[tuple[str, int], np.ndarray]
    masks: dict[tuple[str, int], np.ndarray]

    def on_black(self, camera: str, frame: int) -> np.ndarray:
        """The photograph with its background removed."""
        alpha = self.masks[camera, frame][..., None] / 255.0
        return np.clip(self.photographs[camera, frame] - (1 - alpha) * ROOM, 0, 255).astype(np.uint8)


@cache
def make_scene(
    *, lens: tuple[float, ...] | None = None, square_pixels: bool = False, names: tuple[str, ...] = ("A", "B", "C")
) -> Scene:
    """Deterministic; antialiased."""
    body = load_body()
    params = _params()
    posed = body.forward(params).vertices
    meshes = {frame: body.mesh(vertices) for frame, vertices in enumerate(posed)}
    cameras = {name: _camera(name, k, square_pixels) for k, name in enumerate(names)}
    photographs, masks = {}, {}
    rng = np.random.default_rng(7)
    for name, camera in cameras.items():
        for frame, mesh in meshes.items():
            drawn = mesh if lens is None else through_lens(mesh, camera, lens)
            alpha = _coverage(drawn, camera)
            noise = rng.integers(-8, 8, (HEIGHT, WIDTH, 1))
            mixed = alpha[..., None] * SKIN + (1 - alpha[..., None]) * ROOM
            photographs[name, frame] = (mixed + noise).astype(np.uint8)
            masks[name, frame] = np.round(alpha * 255).astype(np.uint8)
    return Scene(cameras, lens, params, meshes, photographs, masks)


def through_lens(mesh: TriangleMesh, camera: Camera, coefficients: tuple[float, ...]) -> TriangleMesh:
    """The mesh whose pinhole picture is the distorted picture of `mesh`, whose faces are far smaller than a pixel."""
    rotation, shift = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    x, y, z = (mesh.vertices @ rotation.T + shift).T
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = coefficients
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
            np.ones_like(z),
        ]
    )
    return TriangleMesh((bent * z - shift[:, None]).T @ rotation, mesh.faces)


def _coverage(mesh: TriangleMesh, camera: Camera, factor: int = 3) -> np.ndarray:
    """(H, W) share of each pixel that the mesh covers, from factor x factor samples."""
    scale = np.diag([factor, factor, 1.0])
    fine = replace(camera, K=scale @ camera.K, width=camera.width * factor, height=camera.height * factor)
    mask = rasterize_mesh(mesh, fine).mask
    return mask.reshape(camera.height, factor, camera.width, factor).mean(axis=(1, 3))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / (a | b).sum())


def _params() -> BodyParams:
    pose = np.zeros((2, 55, 3))
    pose[0, 16], pose[0, 17], pose[0, 1] = (0, 0, -0.9), (0, 0.3, 0.4), (-0.5, 0, 0.1)
    pose[1, 16], pose[1, 18], pose[1, 5] = (0, -0.8, 0.3), (0, -0.6, 0), (0.7, 0, 0)
    pose[:, 0] = [(0.1, 0.5, -0.05), (-0.1, -0.7, 0.1)]
    rng = np.random.default_rng(3)
    return BodyParams.from_full_pose(
        pose,
        betas=np.repeat(rng.normal(size=(1, 10)) * 0.5, 2, axis=0),
        expression=np.zeros((2, 10)),
        transl=np.array([[0.1, 0.9, 0.2], [-0.15, 0.85, 0.05]]),
    )


def _camera(name: str, index: int, square_pixels: bool) -> Camera:
    angle = np.radians(-50 + 70 * index)
    eye = np.array([2.3 * np.sin(angle), 1.2 + 0.3 * index, 2.3 * np.cos(angle)])
    camera = Camera.look_at(eye=eye, target=np.array([0, 0.75, 0.1]), fov_y_deg=62, width=WIDTH, height=HEIGHT)
    roll = np.radians(4.0 * index - 3)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    K = camera.K.copy()
    K[:2, 2] += [5.25 - 3 * index, -4.5 + 2 * index]
    K[1, 1] *= 1.0 if square_pixels else 1.02
    return replace(camera, K=K, cam_from_world=turn @ camera.cam_from_world, name=name)
