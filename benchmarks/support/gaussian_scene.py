"""Gaussians on a body made of ellipsoids, 1.8 m tall, as an avatar has them: flat, on the surface, in random order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

# Centre and half axes in metres: head, chest, hips, legs, arms, feet.
_ELLIPSOIDS = np.array(
    [
        [[0, 1.66, 0], [0.09, 0.13, 0.11]],
        [[0, 1.27, 0], [0.20, 0.30, 0.13]],
        [[0, 0.92, 0], [0.19, 0.16, 0.14]],
        [[-0.11, 0.47, 0], [0.085, 0.46, 0.09]],
        [[0.11, 0.47, 0], [0.085, 0.46, 0.09]],
        [[-0.35, 1.20, 0], [0.06, 0.34, 0.06]],
        [[0.35, 1.20, 0], [0.06, 0.34, 0.06]],
        [[-0.12, 0.04, 0.06], [0.05, 0.04, 0.13]],
        [[0.12, 0.04, 0.06], [0.05, 0.04, 0.13]],
    ]
)
DISTANCE = 3.5
"""Metres from the camera to the body."""


@dataclass(frozen=True)
class BenchmarkScene:
    """One camera's view of N Gaussians with D channels."""

    means: Tensor  # (N, 3)
    quats: Tensor  # (N, 4)
    scales: Tensor  # (N, 3)
    opacities: Tensor  # (N,)
    features: Tensor  # (N, D)
    viewmat: Tensor  # (4, 4)
    K: Tensor  # (3, 3)
    width: int
    height: int

    @property
    def gaussians(self) -> tuple[Tensor, ...]:
        return self.means, self.quats, self.scales, self.opacities, self.features

    def with_channels(self, channels: int) -> BenchmarkScene:
        """The first `channels` of the features, repeated where there are not enough."""
        repeats = -(-channels // self.features.shape[1])
        return replace(self, features=self.features.repeat(1, repeats)[:, :channels].contiguous())


def body_scene(count: int, width: int, height: int, *, sigma: float = 0.008, channels: int = 10) -> BenchmarkScene:
    """`count` Gaussians of about `sigma` metres (a log-normal spread of .3) along the surface, a hundredth of it thick.

    Opacities are uniform in [.5, .95]; the body fills the height of the image.
    """
    rng = np.random.default_rng(0)
    points, normals = _sample_surface(rng, count)
    quats = _quats_along(normals, rng.uniform(0, 2 * np.pi, count))
    scales = sigma * np.exp(rng.normal(0, 0.3, (count, 3)))
    scales[:, 0] = 0.01 * sigma
    waves = points @ rng.normal(0, 6, (3, channels)) + rng.normal(0, 0.1, (count, channels))
    turn, focal = 0.3, 0.95 * height * DISTANCE / 1.8
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.diag([1, -1, -1]) @ _rotation_about_y(-turn)
    viewmat[:3, 3] = viewmat[:3, :3] @ [0, -0.9, 0] + [0, 0, DISTANCE]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    arrays = (points, quats, scales, rng.uniform(0.5, 0.95, count), 0.5 + 0.5 * np.sin(waves), viewmat, K)
    return BenchmarkScene(*(torch.as_tensor(array.astype(np.float32)) for array in arrays), width, height)


def _sample_surface(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals, uniform over the ellipsoids' area: directions on a sphere, accepted by the stretch."""
    centers, axes = _ELLIPSOIDS[:, 0], _ELLIPSOIDS[:, 1]
    weight = axes.prod(1) / axes.min(1)  # an upper bound of the stretch of the area
    points, normals, found = [], [], 0
    while found < count:
        part = rng.choice(len(axes), 2 * count, p=weight / weight.sum())
        direction = rng.normal(size=(2 * count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        scaled = direction / axes[part]
        stretch = axes[part].prod(1) * np.linalg.norm(scaled, axis=1)
        kept = rng.random(2 * count) < stretch / weight[part]
        points.append(centers[part[kept]] + direction[kept] * axes[part[kept]])
        normals.append(scaled[kept] / np.linalg.norm(scaled[kept], axis=1, keepdims=True))
        found += int(kept.sum())
    return np.concatenate(points)[:count], np.concatenate(normals)[:count]


def _quats_along(normals: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotations (wxyz) that turn x to the normal after a turn about x by the angle."""
    align = np.concatenate([1 + normals[:, :1], np.zeros((len(normals), 1)), -normals[:, 2:], normals[:, 1:2]], 1)
    align[normals[:, 0] < -0.999999] = [0, 0, 1, 0]
    align /= np.linalg.norm(align, axis=1, keepdims=True)
    w, x = np.cos(angles / 2), np.sin(angles / 2)
    a, b, c, d = align.T
    return np.stack([a * w - b * x, a * x + b * w, c * w + d * x, d * w - c * x], 1)


def _rotation_about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
