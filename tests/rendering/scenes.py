"""Small scenes for the tests of the rasteriser: random ones that stay away from its thresholds, and hand-made ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avatar.rendering import RasterMeta, rasterize
from tests.rendering.scalar_rasterizer import alphas_of, depths_of

LEAVES = ("means", "quats", "scales", "opacities", "features", "background", "viewmats")
"""What the fast backends give gradients to."""
ALPHA_GAP = 2e-4
"""Relative distance of every alpha to the thresholds 1/255 and .999, far above float32's rounding of it."""
TRANSMITTANCE_GAP = 2e-3
"""The same of every transmittance to 1e-4; it is a product of many factors."""
DEPTH_GAP = 1e-5
"""Metres between the depths of any two Gaussians, so that all backends sort them alike."""


@dataclass(frozen=True)
class Scene:
    """Arguments of `rasterize`; the values are float32's, the dtype may be float64."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    background: Tensor | None = None

    def replace(self, **changes) -> Scene:
        return dataclasses.replace(self, **changes)

    def mapped(self, function) -> Scene:
        """With `function` applied to every tensor."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return self.replace(**{name: function(value) for name, value in fields.items() if isinstance(value, Tensor)})

    def of(self, backend: str) -> Scene:
        """In the dtype and on the device that a backend takes."""
        dtype = torch.float64 if backend == "reference" else torch.float32
        return self.mapped(lambda tensor: tensor.to("cuda" if backend == "gsplat" else "cpu", dtype))

    def kept(self, index: Tensor) -> Scene:
        """The Gaussians of `index` alone."""
        names = ("means", "quats", "scales", "opacities")
        chosen = {name: getattr(self, name)[index] for name in names}
        return self.replace(**chosen, features=self.features[..., index, :])


def draw(scene: Scene, backend: str, **options) -> tuple[Tensor, Tensor, RasterMeta]:
    """The scene by one backend: image and alpha in float64 on the CPU."""
    image, alpha, meta = rasterize(**vars(scene.of(backend)), backend=backend, **options)
    return image.detach().cpu().double(), alpha.detach().cpu().double(), meta


def gradients(scene: Scene, backend: str, seed: int = 0, **options) -> dict[str, Tensor]:
    """Gradients in float64 on the CPU of a random linear function of image, alpha and (where asked for) depth."""
    leaves = scene.of(backend).mapped(lambda tensor: tensor.clone().requires_grad_())
    leaves = leaves.replace(Ks=leaves.Ks.detach())
    image, alpha, meta = rasterize(**vars(leaves), backend=backend, camera_gradients=True, **options)
    rng = np.random.default_rng(seed)
    outputs = [image, alpha] + ([] if meta.depth is None else [meta.depth])
    loss = sum((output * torch.as_tensor(rng.normal(size=output.shape)).to(output)).sum() for output in outputs)
    loss.backward()
    names = [name for name in LEAVES if getattr(leaves, name) is not None]
    return {name: getattr(leaves, name).grad.cpu().double() for name in names}


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) world to camera for a camera at `eye`: z towards `target`, y down where +Y is up."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


def random_scene(
    seed: int,
    *,
    count: int = 120,
    width: int = 45,
    height: int = 37,
    channels: int = 4,
    cameras: int = 1,
    sigma: float = 0.06,
    spread: float = 0.4,
    features_per_camera: bool = False,
) -> Scene:
    """A cloud of Gaussians (`sigma` and `spread` in metres), 3 m before cameras around it; some are behind or outside.

    No alpha, transmittance or order of two depths is near a threshold: every rounding gives the same picture.
    """
    rng = np.random.default_rng(seed)
    means = rng.normal(0, spread, (count, 3))
    means[: count // 20] *= 15
    angles = 0.4 + np.arange(cameras) * 1.1
    eyes = 3 * np.stack([np.sin(angles), 0.2 * np.cos(3 * angles), np.cos(angles)], -1)
    focal = 1.2 * height * rng.uniform(0.9, 1.1, (cameras, 2))
    Ks = np.tile(np.eye(3), (cameras, 1, 1))
    Ks[:, [0, 1], [0, 1]] = focal
    Ks[:, :2, 2] = np.array([width, height]) * rng.uniform(0.45, 0.55, (cameras, 2))
    shape = (cameras, count, channels) if features_per_camera else (count, channels)
    arrays = {
        "means": means,
        "quats": rng.normal(size=(count, 4)),
        "scales": sigma * np.exp(rng.normal(0, 0.6, (count, 3))),
        "opacities": rng.uniform(0.05, 0.99, count),
        "features": rng.normal(size=shape),
        "viewmats": np.stack([look_at(eye, np.zeros(3)) for eye in eyes]),
        "Ks": Ks,
        "background": rng.uniform(size=(cameras, channels)),
    }
    rounded = {name: torch.as_tensor(value.astype(np.float32)).double() for name, value in arrays.items()}
    return away_from_thresholds(Scene(**rounded, width=width, height=height))


def away_from_thresholds(scene: Scene) -> Scene:
    """Without the Gaussians that are too near a threshold at some pixel, or too near another one in depth."""
    while True:
        bad = np.zeros(len(scene.means), bool)
        for camera in range(len(scene.viewmats)):
            depths = depths_of(scene, camera)
            order = np.argsort(depths, kind="stable")
            bad[order[1:]] |= np.diff(depths[order]) < DEPTH_GAP
            alpha = alphas_of(scene, camera)
            for threshold in (1 / 255, 0.999):
                bad |= (np.abs(alpha / threshold - 1) < ALPHA_GAP).any((0, 1))
            kept = np.where(alpha >= 1 / 255, np.minimum(alpha, 0.999), 0)[..., order]
            near_stop = np.abs(np.cumprod(1 - kept, -1) / 1e-4 - 1) < TRANSMITTANCE_GAP
            bad[order] |= near_stop.any((0, 1))
        if not bad.any():
            return scene
        scene = scene.kept(torch.as_tensor(~bad))


def facing_scene(depths: list[float], opacities: list[float], *, scale: float = 0.05, width: int = 9) -> Scene:
    """Isotropic Gaussians on the axis of a camera at the origin that looks along z; one channel each.

    The axis meets the centre of the middle pixel; the focal length is 20 pixels.
    """
    count = len(depths)
    K = torch.tensor([[20.0, 0, width / 2], [0, 20.0, width / 2], [0, 0, 1]], dtype=torch.float64)
    return Scene(
        means=torch.tensor([[0, 0, z] for z in depths], dtype=torch.float64).reshape(count, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1),
        scales=torch.full((count, 3), scale, dtype=torch.float64),
        opacities=torch.tensor(opacities, dtype=torch.float64),
        features=torch.eye(count, dtype=torch.float64) if count else torch.zeros(0, 1, dtype=torch.float64),
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=K[None],
        width=width,
        height=width,
    )
