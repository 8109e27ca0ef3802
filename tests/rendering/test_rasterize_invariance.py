"""What must not change an image, and what must change it in a known way."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.rendering import rasterize
from tests.rendering.backends import ALL_BACKENDS, FAST_BACKENDS, GRADIENT_TOLERANCE, IMAGE_TOLERANCE
from tests.rendering.scenes import LEAVES, Scene, draw, gradients, random_scene

REARRANGED = 10
"""Two ways of computing the same image may each be this many times off the tolerance of one: inputs are rounded too."""


def assert_same_image(first: Scene, second: Scene, backend: str, **options):
    tolerance = REARRANGED * IMAGE_TOLERANCE[backend]
    for before, after in zip(draw(first, backend)[:2], draw(second, backend, **options)[:2], strict=True):
        np.testing.assert_allclose(after, before, atol=tolerance)
    assert draw(first, backend)[1].max() > 0.5


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(21, cameras=2)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_moving_world_and_cameras_together_changes_nothing(backend, scene):
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
    moved_from_world = np.eye(4)
    moved_from_world[:3, :3], moved_from_world[:3, 3] = turn.as_matrix(), [0.4, -0.2, 1.5]
    rotations = Rotation.from_quat(np.roll(scene.quats.numpy(), -1, 1))
    moved = scene.replace(
        means=scene.means @ torch.as_tensor(moved_from_world[:3, :3].T) + torch.as_tensor(moved_from_world[:3, 3]),
        quats=torch.as_tensor(np.roll((turn * rotations).as_quat(), 1, 1)),
        viewmats=scene.viewmats @ torch.as_tensor(np.linalg.inv(moved_from_world)),
    )
    assert_same_image(scene, moved, backend)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_length_and_sign_of_quaternions_do_not_matter(backend, scene):
    factors = torch.tensor([-1.0, 3.7, -0.02], dtype=torch.float64).repeat(len(scene.quats))[: len(scene.quats)]
    assert_same_image(scene, scene.replace(quats=scene.quats * factors[:, None]), backend)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_the_unit_of_length_does_not_matter(backend, scene):
    viewmats = scene.viewmats.clone()
    viewmats[:, :3, 3] *= 1000
    millimetres = scene.replace(means=scene.means * 1000, scales=scene.scales * 1000, viewmats=viewmats)
    assert_same_image(scene, millimetres, backend, near=10.0, far=1e13)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_the_order_of_gaussians_does_not_matter(backend, scene):
    order = torch.as_tensor(np.random.default_rng(0).permutation(len(scene.means)))
    assert_same_image(scene, scene.kept(order), backend)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_the_principal_point_moves_the_image(backend):
    """By whole pixels; the Gaussians are well inside, where the clamp of the Jacobian does not act."""
    scene = random_scene(22, sigma=0.03, count=60)
    scene = scene.replace(means=0.3 * scene.means / scene.means.norm(dim=-1, keepdim=True))
    Ks = scene.Ks.clone()
    Ks[:, 0, 2] += 3
    Ks[:, 1, 2] -= 2
    before, after = draw(scene, backend)[0], draw(scene.replace(Ks=Ks), backend)[0]
    assert before.std() > 0.05
    np.testing.assert_allclose(after[:, :-2, 3:], before[:, 2:, :-3], atol=REARRANGED * IMAGE_TOLERANCE[backend])


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_the_image_is_linear_in_features_and_background(backend, scene):
    other = scene.replace(features=scene.features.flip(0), background=scene.background.flip(-1))
    mixed = scene.replace(
        features=2 * scene.features - other.features, background=2 * scene.background - other.background
    )
    expected = 2 * draw(scene, backend)[0] - draw(other, backend)[0]
    np.testing.assert_allclose(draw(mixed, backend)[0], expected, atol=REARRANGED * IMAGE_TOLERANCE[backend])


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_a_batch_is_its_cameras_one_by_one(backend):
    scene = random_scene(23, cameras=3, features_per_camera=True)
    image, alpha, meta = draw(scene, backend)
    for camera in range(3):
        one = slice(camera, camera + 1)
        single = scene.replace(
            features=scene.features[one],
            viewmats=scene.viewmats[one],
            Ks=scene.Ks[one],
            background=scene.background[one],
        )
        again, again_alpha, again_meta = draw(single, backend)
        assert torch.equal(image[one], again)
        assert torch.equal(alpha[one], again_alpha)
        assert torch.equal(meta.means2d[one], again_meta.means2d)


@pytest.mark.parametrize("backend", ALL_BACKENDS)
def test_shared_features_and_background_are_those_of_every_camera(backend, scene):
    repeated = scene.replace(features=scene.features.repeat(2, 1, 1), background=scene.background[:1].repeat(2, 1))
    shared = scene.replace(background=scene.background[0])
    assert torch.equal(draw(repeated, backend)[0], draw(shared, backend)[0])
    no_background = draw(scene.replace(background=None), backend)[0]
    zero = draw(scene.replace(background=torch.zeros_like(scene.background)), backend)[0]
    np.testing.assert_allclose(no_background, zero, atol=1e-7)


@pytest.mark.parametrize("backend", FAST_BACKENDS)
@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (0, {"cameras": 2}),
        (1, {"count": 250, "sigma": 0.15, "channels": 10}),
        (2, {"cameras": 2, "features_per_camera": True, "channels": 1}),
        (4, {"sigma": 0.4, "spread": 2.0, "count": 80}),
        (3, {"count": 400, "sigma": 0.01, "channels": 37, "width": 70}),
    ],
)
@pytest.mark.parametrize("depth", [None, "expected"])
def test_fast_backends_equal_the_reference(backend, seed, options, depth):
    scene = random_scene(seed, **options)
    image, alpha, meta = draw(scene, backend, depth=depth)
    expected, expected_alpha, expected_meta = draw(scene, "reference", depth=depth)
    np.testing.assert_allclose(image, expected, atol=IMAGE_TOLERANCE[backend] * expected.abs().max())
    np.testing.assert_allclose(alpha, expected_alpha, atol=IMAGE_TOLERANCE[backend])
    # gsplat's boxes are rounded up: more of them touch the image.
    visible, seen = meta.visible.cpu(), expected_meta.visible
    assert visible[seen].all() and not meta.means2d.cpu()[~visible].any()
    np.testing.assert_allclose(meta.means2d.cpu()[seen], expected_meta.means2d[seen], atol=1e-3, rtol=1e-5)
    if backend == "cpu":
        assert torch.equal(visible, seen)
        np.testing.assert_allclose(meta.radii, expected_meta.radii, rtol=1e-4)
    if depth is not None:
        np.testing.assert_allclose(meta.depth.cpu(), expected_meta.depth, atol=1e-4)


@pytest.mark.parametrize("backend", FAST_BACKENDS)
@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (0, {"cameras": 2}),
        (1, {"count": 250, "sigma": 0.15, "channels": 10}),
        (2, {"cameras": 2, "features_per_camera": True, "channels": 1}),
        (4, {"sigma": 0.4, "spread": 2.0, "count": 80}),
    ],
)
def test_fast_gradients_equal_those_of_the_reference(backend, seed, options):
    scene = random_scene(seed, **options)
    found, truth = (gradients(scene, name, depth="accumulated") for name in (backend, "reference"))
    for name, expected in truth.items():
        error = (found[name] - expected).abs().max() / expected.abs().max()
        assert error < GRADIENT_TOLERANCE[backend], f"{name}: {error:.2g}"


@pytest.mark.parametrize("backend", FAST_BACKENDS)
@pytest.mark.parametrize("output", [0, 1])
def test_a_loss_of_one_output_alone(backend, output):
    """Image without alpha, alpha without image: the other's gradient does not come as zeros, but not at all."""
    scene, found = random_scene(25, cameras=2), {}
    for name in (backend, "reference"):
        leaves = scene.of(name).mapped(lambda tensor: tensor.clone().requires_grad_())
        leaves = leaves.replace(Ks=leaves.Ks.detach())
        rasterize(**vars(leaves), backend=name, camera_gradients=True)[output].square().sum().backward()
        found[name] = {leaf: getattr(leaves, leaf).grad for leaf in LEAVES}
    for leaf, expected in found["reference"].items():
        if expected is None or not expected.any():
            assert found[backend][leaf] is None or not found[backend][leaf].any(), leaf
        else:
            error = (found[backend][leaf].cpu() - expected).abs().max() / expected.abs().max()
            assert error < GRADIENT_TOLERANCE[backend], f"{leaf}: {error:.2g}"


def test_gradients_of_expected_depth_are_those_of_finite_differences():
    """Through the division by alpha, and where nothing is seen."""
    scene = random_scene(24, count=8, width=9, height=7, channels=1, sigma=0.1)
    assert (draw(scene, "reference")[1] == 0).any()

    def depth_of(means, opacities, viewmats):
        moved = scene.replace(means=means, opacities=opacities, viewmats=viewmats)
        options = {"backend": "reference", "camera_gradients": True, "depth": "expected"}
        return rasterize(**vars(moved), **options, check=False)[2].depth

    leaves = [getattr(scene, name).clone().requires_grad_() for name in ("means", "opacities", "viewmats")]
    assert torch.autograd.gradcheck(depth_of, leaves, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)
