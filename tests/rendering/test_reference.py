"""The reference rasteriser against a second implementation, against finite differences and against its own rules."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.rendering.reference import BLOCK, rasterize_reference
from avatar.rendering.settings import RasterSettings
from tests.rendering.scalar_rasterizer import alphas_of, depths_of, project, rasterize_scalar
from tests.rendering.scenes import Scene, draw, random_scene


def arguments(scene: Scene) -> tuple:
    names = ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks", "background")
    return tuple(getattr(scene, name) for name in names)


@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (0, {"cameras": 2}),
        (1, {"count": 250, "sigma": 0.15, "channels": 2}),
        (2, {"cameras": 3, "count": 60, "features_per_camera": True}),
        (3, {"width": BLOCK + 1, "height": 5, "channels": 1}),
        (4, {"sigma": 0.4, "spread": 2.0, "count": 80}),
    ],
)
def test_equals_the_scalar_implementation(seed, options):
    scene = random_scene(seed, **options)
    assert len(scene.means) > options.get("count", 120) / 2
    image, alpha, _ = draw(scene, "reference")
    for camera in range(len(scene.viewmats)):
        expected, coverage = rasterize_scalar(scene, camera)
        np.testing.assert_allclose(image[camera], expected, atol=1e-12)
        np.testing.assert_allclose(alpha[camera, ..., 0], coverage, atol=1e-12)
    assert alpha.max() > 0.5


def test_the_dense_scene_reaches_the_stop():
    """Otherwise the comparison above would not test it."""
    alphas = np.minimum(alphas_of(random_scene(1, count=250, sigma=0.15, channels=2), 0), 0.999)
    assert (np.where(alphas >= 1 / 255, 1 - alphas, 1).prod(-1) < 1e-4).mean() > 0.05


def test_meta_tells_where_gaussians_are():
    scene = random_scene(4, cameras=2)
    _, _, meta = draw(scene, "reference")
    for camera in range(2):
        reaches = alphas_of(scene, camera) >= 1 / 255
        visible = meta.visible[camera].numpy()
        assert not reaches[..., ~visible].any()
        centers, _ = project(scene, camera)
        np.testing.assert_allclose(meta.means2d[camera, visible], centers[visible], atol=1e-10)
        np.testing.assert_allclose(meta.depths[camera], depths_of(scene, camera), atol=1e-12)
        rows, columns, gaussian = np.nonzero(reaches)
        offset = np.abs(np.stack([columns + 0.5, rows + 0.5], -1) - centers[gaussian])
        assert (offset <= meta.radii[camera, gaussian].numpy()).all()
        assert not meta.means2d[camera, ~visible].any()
    assert 0 < meta.visible.sum() < meta.visible.numel()


def test_gradients_are_those_of_finite_differences():
    scene = random_scene(5, count=8, width=7, height=6, channels=2, cameras=2, sigma=0.25)
    settings = RasterSettings(scene.width, scene.height)
    leaves = [tensor.clone().requires_grad_() for tensor in arguments(scene)]
    assert len(scene.means) >= 6

    def images(*tensors):
        return rasterize_reference(*tensors, settings)[:2]

    # Along random directions of each tensor: all entries one by one take twenty seconds.
    assert torch.autograd.gradcheck(images, leaves, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


def test_gradients_are_finite_with_gaussians_behind_and_beside_the_camera():
    scene = random_scene(6)
    means = scene.means.clone()
    means[:3] = -torch.linalg.inv(scene.viewmats[0])[:3, 2] * torch.tensor([[0.0], [-9.0], [1.0]])
    means[3] = torch.linalg.inv(scene.viewmats[0])[:3, 3]
    leaves = [tensor.clone().requires_grad_() for tensor in arguments(scene.replace(means=means))]
    image, alpha, _ = rasterize_reference(*leaves, RasterSettings(scene.width, scene.height))
    (image.sum() + alpha.sum()).backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves)


def test_float32_is_near_float64():
    scene = random_scene(7, cameras=2)
    single = scene.mapped(torch.Tensor.float)
    image, _, _ = rasterize_reference(*arguments(single), RasterSettings(scene.width, scene.height))
    assert image.dtype == torch.float32
    assert (image - draw(scene, "reference")[0]).abs().max() < 5e-6
