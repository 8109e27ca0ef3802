"""The native kernels at every instruction set that this CPU has, against the oracle."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from avatar.rendering import cpu, rasterize
from avatar.rendering.cpu import Workspace
from smplxpp import native
from tests.rendering.scenes import Scene, draw, facing_scene, gradients, random_scene

IMAGE_TOLERANCE = {"avx512": 1e-6, "avx2": 1e-6, "generic": 2e-6}
"""Largest error of values of order 1; without fused multiply-add every product is rounded once more."""
GRADIENT_TOLERANCE = 1e-5
"""Largest error of a gradient, as a share of its largest entry."""
USABLE = native.usable_levels()


@pytest.fixture(params=USABLE)
def level(request, monkeypatch) -> str:
    monkeypatch.setattr(cpu, "Workspace", partial(Workspace, request.param))
    return request.param


@pytest.fixture
def two_threads():
    """The kernels as they run on two threads, whatever the tests were started with."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


CASES = {
    "one channel": {"channels": 1, "sigma": 0.02},
    "partial tiles": {"channels": 3, "width": 37, "height": 29},
    "one pixel": {"channels": 3, "width": 1, "height": 1},
    "one row": {"channels": 5, "width": 70, "height": 1},
    "two cameras": {"channels": 10, "cameras": 2},
    "one more than a row holds": {"channels": 11},
    "two rows": {"channels": 17, "cameras": 2, "features_per_camera": True},
    "four rows": {"channels": 40, "count": 60},
    "large": {"sigma": 0.6, "count": 60},
    "small": {"sigma": 0.002, "count": 150},
    "several chunks of a list": {"count": 700, "sigma": 0.03, "width": 20, "height": 20},
}


def assert_equals_oracle(level: str, scene: Scene, **options):
    for ours, truth in zip(draw(scene, "cpu", **options)[:2], draw(scene, "reference", **options)[:2], strict=True):
        largest = max(1.0, float(truth.abs().max()))
        np.testing.assert_allclose(ours, truth, rtol=0, atol=IMAGE_TOLERANCE[level] * largest)
    ours, truth = gradients(scene, "cpu", **options), gradients(scene, "reference", **options)
    assert truth["means"].abs().max() > 0
    for name, expected in truth.items():
        error = (ours[name] - expected).abs().max()
        assert error <= GRADIENT_TOLERANCE * max(float(expected.abs().max()), 1e-6), name


@pytest.mark.parametrize("case", CASES)
def test_images_and_gradients_are_those_of_the_oracle(level, two_threads, case):
    assert_equals_oracle(level, random_scene(len(case), **CASES[case]))


def test_without_a_background(level):
    assert_equals_oracle(level, random_scene(3, channels=12).replace(background=None))


def test_other_planes_and_blur(level):
    assert_equals_oracle(level, random_scene(4), near=2.8, far=3.3, eps2d=0.05)


def test_an_opaque_wall_stops_the_light(level):
    """Behind it nothing counts, in the picture and in the gradients."""
    scene = facing_scene([1.0 + 0.01 * i for i in range(12)], [0.7, 1.0, 1.0, 0.9] * 3, scale=3.0)
    assert_equals_oracle(level, scene.replace(background=torch.ones(1, 12, dtype=torch.float64)))
    assert gradients(scene, "cpu")["features"][6:].abs().max() == 0


def test_a_large_picture_is_as_exact_as_a_small_one(level):
    """Positions are kept in more than single precision: 1e-4 of a pixel would be seen at 2000 of them."""
    scene = random_scene(7, count=60, width=30, height=24, sigma=0.002)
    Ks = scene.Ks.clone()
    Ks[:, 0, 2] += 2000
    wide = scene.replace(Ks=Ks.float().double(), width=2030)
    image, truth = (np.asarray(draw(wide, backend)[0])[:, :, 2000:] for backend in ("cpu", "reference"))
    assert np.abs(truth - np.asarray(scene.background)[:, None, None]).max() > 0.1
    np.testing.assert_allclose(image, truth, rtol=0, atol=2e-6)


def test_all_levels_draw_the_same_picture():
    scene = random_scene(9, count=300, channels=6).of("cpu")
    pictures = []
    for name in USABLE:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cpu, "Workspace", partial(Workspace, name))
            pictures.append(rasterize(**vars(scene))[0])
    for picture in pictures[1:]:
        assert (picture - pictures[0]).abs().max() < 2e-6 * pictures[0].abs().max()


def test_every_gaussian_outside_behind_or_faint(level):
    scene = random_scene(5, count=30)
    outside = scene.means.clone()
    outside[:10] += 500.0
    faint = scene.opacities.clone()
    faint[10:20] = 0.003
    behind = outside.clone()
    behind[20:] *= -1
    nothing = scene.replace(means=outside, opacities=faint).kept(torch.arange(30) < 20)
    image, alpha, meta = draw(nothing, "cpu")
    assert not np.asarray(meta.visible).any()
    assert not np.asarray(alpha).any()
    np.testing.assert_array_equal(image, np.broadcast_to(scene.of("cpu").background[:, None, None], image.shape))
    assert all(not value.any() for name, value in gradients(nothing, "cpu").items() if name != "background")


def test_unchecked_garbage_does_not_end_the_process(level):
    """NaN, infinity and absurd sizes in every argument, unchecked: any picture will do, but there has to be one."""
    rng = np.random.default_rng(0)
    poison = [float("nan"), float("inf"), -float("inf"), 1e38, -1e38, 1e-38, 0.0, 1e9]
    for trial in range(12):
        scene = random_scene(trial, count=80, width=33, height=18).of("cpu")
        for name in ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks", "background"):
            values = getattr(scene, name).view(-1)
            values[torch.as_tensor(rng.integers(len(values), size=3))] = torch.tensor(rng.choice(poison, 3)).float()
        leaves = scene.mapped(lambda tensor: tensor.clone().requires_grad_())
        image, alpha, _ = rasterize(**vars(leaves.replace(Ks=scene.Ks)), check=False, backend="cpu")
        (image.sum() + alpha.sum()).backward()
        assert image.shape == (1, 18, 33, 4)
