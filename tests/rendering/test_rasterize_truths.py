"""What every backend must draw, from formulas that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.rendering import rasterize
from tests.rendering.backends import ALL_BACKENDS, IMAGE_TOLERANCE
from tests.rendering.scenes import Scene, draw, facing_scene, random_scene

FOCAL = 20.0
BLUR = 0.3

pytestmark = pytest.mark.parametrize("backend", ALL_BACKENDS)


def bump(opacity: float, variance: float | np.ndarray, width: int = 9) -> np.ndarray:
    """(width, width) opacity of a Gaussian on the middle pixel; `variance` in pixels squared, along x and y."""
    offset = np.arange(width) - width // 2
    var_x, var_y = np.broadcast_to(variance, 2)
    alpha = opacity * np.exp(-(offset[None, :] ** 2) / (2 * var_x) - offset[:, None] ** 2 / (2 * var_y))
    return np.where(alpha >= 1 / 255, alpha, 0)


def assert_image(image, expected, backend):
    np.testing.assert_allclose(image, expected, atol=5 * IMAGE_TOLERANCE[backend])


@pytest.mark.parametrize(("depth", "scale", "opacity"), [(2.0, 0.1, 0.8), (5.0, 0.3, 0.3), (1.0, 0.001, 0.9)])
def test_one_gaussian_on_the_axis(backend, depth, scale, opacity):
    image, alpha, _ = draw(facing_scene([depth], [opacity], scale=scale), backend)
    expected = bump(opacity, (FOCAL * scale / depth) ** 2 + BLUR)
    assert (expected == 0).any()
    assert_image(alpha[0, ..., 0], expected, backend)
    assert_image(image[0, ..., 0], expected, backend)


def test_scales_follow_the_rotated_axes(backend):
    """A long z axis is not seen; a quarter turn about z takes x to y."""
    half = np.sqrt(0.5)
    scene = facing_scene([2.0], [0.7]).replace(
        scales=torch.tensor([[0.2, 0.05, 3.0]], dtype=torch.float64),
        quats=torch.tensor([[half, 0, 0, half]], dtype=torch.float64),
    )
    _, alpha, _ = draw(scene, backend)
    assert_image(alpha[0, ..., 0], bump(0.7, np.array([0.25, 4.0]) + BLUR), backend)


def test_a_gaussian_beside_the_axis_is_sheared_by_the_perspective(backend):
    """With x/z = a: the pixel moves by f (dx - a dz) / z, so its variance along x is (f s / z)^2 (1 + a^2)."""
    slope, depth, scale = 0.2, 2.0, 0.2
    scene = facing_scene([depth], [0.7], scale=scale)
    scene = scene.replace(means=torch.tensor([[slope * depth, 0, depth]], dtype=torch.float64))
    _, alpha, meta = draw(scene, backend)
    variance = (FOCAL * scale / depth) ** 2
    center = np.arange(9) + 0.5 - (4.5 + FOCAL * slope)
    across = np.exp(-(center**2) / (2 * (variance * (1 + slope**2) + BLUR)))
    down = np.exp(-((np.arange(9) - 4.0) ** 2) / (2 * (variance + BLUR)))
    expected = 0.7 * down[:, None] * across
    assert_image(alpha[0, ..., 0], np.where(expected >= 1 / 255, expected, 0), backend)
    np.testing.assert_allclose(meta.means2d[0, 0].cpu(), [4.5 + FOCAL * slope, 4.5], atol=1e-5)


def test_far_beside_the_image_the_perspective_is_that_of_its_widened_border(backend):
    """Slope 0.6, where the image ends at 4.5 / 20 and its widened frustum at 1.3 times that: 0.2925."""
    depth, scale, limit = 2.0, 0.5, 1.3 * 4.5 / FOCAL
    scene = facing_scene([depth], [0.9], scale=scale)
    scene = scene.replace(means=torch.tensor([[0.6 * depth, 0, depth]], dtype=torch.float64))
    _, alpha, _ = draw(scene, backend)
    variance = (FOCAL * scale / depth) ** 2
    offset = np.arange(9) + 0.5 - (4.5 + FOCAL * 0.6)
    across = np.exp(-(offset**2) / (2 * (variance * (1 + limit**2) + BLUR)))
    assert_image(alpha[0, 4, :, 0], 0.9 * np.where(0.9 * across >= 1 / 255, across, 0), backend)
    assert alpha[0, 4, 8] > 0.1


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]])
def test_gaussians_are_blended_nearest_first(backend, order):
    scene = facing_scene([2.0, 3.0, 4.0], [0.5, 0.6, 0.7]).kept(torch.tensor(order))
    background = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
    image, alpha, _ = draw(scene.replace(background=background), backend)
    near, middle, far = (bump(o, (FOCAL * 0.05 / z) ** 2 + BLUR) for o, z in [(0.5, 2.0), (0.6, 3.0), (0.7, 4.0)])
    left = (1 - near) * (1 - middle) * (1 - far)
    weights = np.stack([near, (1 - near) * middle, (1 - near) * (1 - middle) * far], -1)
    assert_image(image[0], weights + left[..., None] * background.numpy(), backend)
    assert_image(alpha[0, ..., 0], 1 - left, backend)


def test_an_opaque_gaussian_keeps_a_thousandth_of_the_light(backend):
    scene = facing_scene([2.0], [1.0]).replace(background=torch.tensor([[7.0]], dtype=torch.float64))
    image, alpha, _ = draw(scene, backend)
    assert abs(alpha[0, 4, 4, 0] - 0.999) < IMAGE_TOLERANCE[backend]
    assert abs(image[0, 4, 4, 0] - (0.999 + 7 * 0.001)) < 10 * IMAGE_TOLERANCE[backend]


def test_blending_stops_for_good(backend):
    """The fourth would leave 5e-5, so it is not blended, nor is the faint fifth, which would leave more than 1e-4."""
    scene = facing_scene([1.0, 2.0, 3.0, 4.0, 5.0], [0.9, 0.9, 0.9, 0.95, 0.02], scale=1.0, width=3)
    image, alpha, _ = draw(scene, backend)
    np.testing.assert_allclose(image[0, 1, 1], [0.9, 0.09, 0.009, 0, 0], atol=IMAGE_TOLERANCE[backend])
    assert abs(alpha[0, 1, 1, 0] - 0.999) < IMAGE_TOLERANCE[backend]


def test_faint_gaussians_are_skipped(backend):
    _, alpha, meta = draw(facing_scene([2.0, 3.0], [0.0039, 0.0041]), backend)
    assert_image(alpha[0, 4, 4], [0.0041], backend)
    assert (alpha > 0).sum() == 1
    assert meta.visible.tolist() == [[False, True]]


def test_centres_before_near_and_behind_far_are_dropped(backend):
    scene = facing_scene([-1.0, 0.5, 1.5, 2.5, 3.5], [0.5] * 5)
    image, _, meta = draw(scene, backend, near=1.0, far=3.0)
    assert meta.visible.tolist() == [[False, False, True, True, False]]
    assert (image[0, 4, 4] > 0).tolist() == [False, False, True, True, False]
    np.testing.assert_allclose(meta.depths.cpu(), [[-1.0, 0.5, 1.5, 2.5, 3.5]], rtol=1e-6)


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_in_front_of_the_camera_is_the_background(backend, count):
    scene = facing_scene([-2.0] * count, [0.5] * count)
    channels = scene.features.shape[-1]
    background = torch.linspace(0.1, 0.9, channels, dtype=torch.float64)
    leaves = scene.of(backend).mapped(lambda tensor: tensor.clone().requires_grad_())
    leaves = leaves.replace(Ks=leaves.Ks.detach(), background=background.clone().to(leaves.means).requires_grad_())
    image, alpha, meta = rasterize(**vars(leaves), backend=backend, depth="expected", camera_gradients=True)
    assert image.shape == (1, 9, 9, channels)
    np.testing.assert_allclose(image.detach().cpu(), background.expand(1, 9, 9, channels), atol=1e-7)
    assert not alpha.detach().any()
    assert not meta.depth.detach().any()
    assert meta.visible.shape == (1, count)
    assert not meta.visible.any()
    (image.sum() + alpha.sum() + meta.depth.sum()).backward()
    assert leaves.background.grad.tolist() == [81.0] * channels
    for name in ("means", "quats", "scales", "opacities", "features", "viewmats"):
        assert not getattr(leaves, name).grad.any(), name


def test_no_camera_is_an_empty_batch(backend):
    scene = facing_scene([2.0], [0.5])
    image, alpha, meta = draw(scene.replace(viewmats=scene.viewmats[:0], Ks=scene.Ks[:0]), backend)
    assert image.shape == (0, 9, 9, 1)
    assert alpha.shape == (0, 9, 9, 1)
    assert meta.means2d.shape == (0, 1, 2)


def wall(width: int = 32, tilt: float = 0.0) -> Scene:
    """A dense sheet of splats 2 m away; `tilt` metres deeper a metre to the right."""
    x, y = np.meshgrid(np.linspace(-2.4, 2.4, 64), np.linspace(-2.4, 2.4, 64))
    means = np.stack([x, y, 2 + tilt * x], -1).reshape(-1, 3)
    scene = facing_scene([2.0] * len(means), [0.5] * len(means), scale=0.04, width=width)
    return scene.replace(means=torch.as_tensor(means), features=torch.ones(len(means), 1, dtype=torch.float64))


def test_depth_of_a_wall(backend):
    _, alpha, meta = draw(wall(), backend, depth="expected")
    assert alpha.min() > 0.5
    np.testing.assert_allclose(meta.depth.cpu(), 2, rtol=1e-5)
    _, _, accumulated = draw(wall(), backend, depth="accumulated")
    np.testing.assert_allclose(accumulated.depth.cpu(), 2 * alpha, rtol=1e-5)


def test_depth_of_a_tilted_wall(backend):
    """On the ray of pixel u the wall is at z = 2 + tilt x = 2 / (1 - tilt (u - c) / f)."""
    tilt, width = 0.3, 32
    _, _, meta = draw(wall(width, tilt), backend, depth="expected")
    slope = (np.arange(width) + 0.5 - width / 2) / FOCAL
    expected = np.broadcast_to(2 / (1 - tilt * slope), (width, width))
    np.testing.assert_allclose(meta.depth[0, ..., 0].cpu(), expected, rtol=0.02)


def test_depth_leaves_the_image_alone_and_counts_from_each_camera(backend):
    scene = random_scene(11, cameras=2)
    plain, _, without = draw(scene, backend)
    image, alpha, meta = draw(scene, backend, depth="accumulated")
    assert without.depth is None
    np.testing.assert_allclose(image, plain, atol=IMAGE_TOLERANCE[backend])
    as_feature = scene.replace(
        features=torch.stack([m[2, :3] @ scene.means.T + m[2, 3] for m in scene.viewmats])[..., None], background=None
    )
    np.testing.assert_allclose(meta.depth.cpu(), draw(as_feature, backend)[0], atol=20 * IMAGE_TOLERANCE[backend])
    expected = draw(scene, backend, depth="expected")[2].depth.cpu().double()
    assert (alpha == 0).any()
    np.testing.assert_allclose(expected * alpha, meta.depth.cpu(), atol=20 * IMAGE_TOLERANCE[backend])
    assert not expected[alpha == 0].any()
