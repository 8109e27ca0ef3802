"""A second opinion on the reference: the same rules from the textbook, in numpy, a pixel and a Gaussian at a time.

Nothing is shared with the package: rotations are scipy's, covariances are inverted by LAPACK, no box or block is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from tests.rendering.scenes import Scene


def depths_of(scene: Scene, camera: int) -> np.ndarray:
    """(N,) z in the camera."""
    view = scene.viewmats[camera].numpy()
    return scene.means.numpy() @ view[2, :3] + view[2, 3]


def project(scene: Scene, camera: int, eps2d: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Centres (N, 2) and covariances (N, 2, 2) in the image."""
    view, K = scene.viewmats[camera].numpy(), scene.Ks[camera].numpy()
    size = np.array([scene.width, scene.height])
    focal, principal = np.array([K[0, 0], K[1, 1]]), K[:2, 2]
    rotations = Rotation.from_quat(np.roll(scene.quats.numpy(), -1, axis=1)).as_matrix()
    centers, covariances = [], []
    for mean, rotation, scale in zip(scene.means.numpy(), rotations, scene.scales.numpy(), strict=True):
        x, y, z = view[:3, :3] @ mean + view[:3, 3]
        centers.append(focal * [x, y] / z + principal)
        low, high = -principal / focal, (size - principal) / focal
        margin = 0.15 * size / focal
        u, v = np.clip([x / z, y / z], low - margin, high + margin)
        J = np.array([[focal[0], 0, -focal[0] * u], [0, focal[1], -focal[1] * v]]) / z
        world = rotation @ np.diag(scale**2) @ rotation.T
        covariances.append(J @ view[:3, :3] @ world @ view[:3, :3].T @ J.T + eps2d * np.eye(2))
    return np.array(centers).reshape(-1, 2), np.array(covariances).reshape(-1, 2, 2)


def alphas_of(scene: Scene, camera: int) -> np.ndarray:
    """(H, W, N) opacity at every pixel before any threshold; 0 behind the camera's near plane of 1 cm."""
    centers, covariances = project(scene, camera)
    visible = depths_of(scene, camera) >= 0.01
    x, y = np.meshgrid(np.arange(scene.width) + 0.5, np.arange(scene.height) + 0.5)
    offset = np.stack([x, y], -1)[:, :, None] - centers
    distance = np.einsum("hwni,nij,hwnj->hwn", offset, np.linalg.inv(covariances), offset)
    return np.where(visible, scene.opacities.numpy() * np.exp(-distance / 2), 0)


def rasterize_scalar(scene: Scene, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, W, D) and alpha (H, W) of one camera."""
    features = scene.features.numpy()[camera] if scene.features.ndim == 3 else scene.features.numpy()
    background = 0 if scene.background is None else scene.background.numpy()[camera]
    alphas, order = alphas_of(scene, camera), np.argsort(depths_of(scene, camera), kind="stable")
    image, coverage = np.zeros((scene.height, scene.width, features.shape[-1])), np.zeros((scene.height, scene.width))
    for row in range(scene.height):
        for column in range(scene.width):
            color, transmittance = np.zeros(features.shape[-1]), 1.0
            for gaussian in order:
                alpha = min(0.999, alphas[row, column, gaussian])
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) <= 1e-4:
                    break
                color += features[gaussian] * alpha * transmittance
                transmittance *= 1 - alpha
            image[row, column] = color + transmittance * background
            coverage[row, column] = 1 - transmittance
    return image, coverage
