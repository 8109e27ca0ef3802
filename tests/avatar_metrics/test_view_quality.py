"""Figures of a view by their stated conventions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avatar.data.views import View
from avatar.losses.perceptual import PerceptualDistance
from avatar.metrics.view_quality import ViewQuality, detail, eight_bit, head_shown, mean_quality, view_quality
from smplxpp.core import Camera, TriangleMesh
from tests.dolls.standing import doll

BLACK = torch.zeros(3)


def view(name: str = "Ring0") -> View:
    return View(doll().cameras[name], torch.tensor(doll().images[name]), torch.tensor(doll().masks[name]))


def test_an_equal_image_is_perfect():
    it = view()
    quality = view_quality(it, it.composited(BLACK), it.opacity(), BLACK, head=(10, 10, 50, 40))
    assert quality.psnr == quality.psnr_image == quality.psnr_head == pytest.approx(120.0)
    assert quality.ssim == pytest.approx(1.0) and quality.ssim_head == pytest.approx(1.0)


def test_a_known_error_on_the_person_alone():
    it = view()
    person = it.opacity() > 0.02
    # Towards the middle, so that nothing is clipped.
    real = it.composited(BLACK)
    image = torch.where(person[..., None], real + torch.where(real > 0.5, -0.1, 0.1), real)
    quality = view_quality(it, image, it.opacity(), BLACK, head=None)
    assert quality.psnr == pytest.approx(20.0, abs=1e-4)
    assert quality.psnr_image == pytest.approx(20.0 - 10 * math.log10(float(person.float().mean())), abs=1e-4)
    assert quality.psnr_head is None


def test_what_is_drawn_beside_the_person_counts():
    it = view()
    image, alpha = it.composited(BLACK), it.opacity().clone()
    image[:5, :5], alpha[:5, :5] = 0.5, 1.0
    union = int((it.opacity() > 0.02).sum()) + 25
    expected = -10 * math.log10(25 * 0.25 / union)
    assert view_quality(it, image, alpha, BLACK, head=None).psnr == pytest.approx(expected, abs=1e-4)


def test_colours_outside_the_screen_are_clamped_first():
    it = view()
    image = it.composited(BLACK) - (it.opacity() == 0)[..., None] * 3.0
    assert view_quality(it, image, it.opacity(), BLACK, head=None).psnr_image == pytest.approx(120.0)


def test_detail_falls_with_blur_and_not_with_a_shift():
    """A picture of the mean of many places has better decibels than a sharp one at a wrong place, and less detail."""
    rng = np.random.default_rng(0)
    pattern = torch.tensor(rng.uniform(size=(64, 64, 3)), dtype=torch.float32)
    shown = torch.zeros(64, 64, dtype=torch.bool)
    shown[10:54, 10:54] = True
    moved = pattern.roll((2, 3), dims=(0, 1))
    blurred = torch.stack([pattern.roll((k, 2 * k), dims=(0, 1)) for k in range(-3, 4)]).mean(dim=0)
    assert (blurred - pattern).square().mean() < 0.7 * (moved - pattern).square().mean()
    assert detail(moved, pattern, shown) == pytest.approx(1.0, abs=0.02)
    assert detail(blurred, pattern, shown) < 0.45
    assert detail(0.5 + 0.25 * (pattern - 0.5), pattern, shown) == pytest.approx(0.25, rel=1e-5)
    noisy = pattern + torch.tensor(rng.normal(size=(64, 64, 3)) * 0.3, dtype=torch.float32)
    assert detail(noisy, pattern, shown) > 1.2


def test_detail_is_of_what_both_show_away_from_silhouettes():
    pattern = torch.tensor(np.random.default_rng(0).uniform(size=(32, 32, 3)), dtype=torch.float32)
    shown = torch.zeros(32, 32, dtype=torch.bool)
    shown[8:24, 8:24] = True
    outside = torch.where(shown[..., None], pattern, torch.ones(3))
    assert detail(outside, pattern, shown) == pytest.approx(1.0, rel=1e-6)
    shown[12::4] = False  # no window of five pixels is left
    shown[:, 12::4] = False
    assert detail(pattern, pattern, shown) is None
    assert detail(pattern, torch.zeros(32, 32, 3), torch.ones(32, 32, dtype=torch.bool)) is None
    assert detail(pattern[:4], pattern[:4], torch.ones(4, 32, dtype=torch.bool)) is None
    it = view()
    assert view_quality(it, it.composited(BLACK), it.opacity(), BLACK, head=None).detail == pytest.approx(1.0)


def test_the_head_alone_counts_neither_its_box_nor_what_is_not_the_person():
    it = view()
    person = it.opacity() > 0.02
    shown = torch.zeros_like(person)
    shown[10:40, 10:40] = True
    real = it.composited(BLACK)
    beside = torch.where((person & ~shown)[..., None], 0.5, real)
    quality = view_quality(it, beside, it.opacity(), BLACK, head=(5, 5, 50, 50), head_pixels=shown)
    assert quality.psnr_head_alone == pytest.approx(120.0) and quality.psnr_head < 40.0
    off = torch.where((person & shown)[..., None], real + torch.where(real > 0.5, -0.1, 0.1), real)
    quality = view_quality(it, off, it.opacity(), BLACK, head=None, head_pixels=shown)
    assert quality.psnr_head_alone == pytest.approx(20.0, abs=1e-4) and quality.psnr_head is None
    nothing = torch.zeros_like(person)
    assert view_quality(it, off, it.opacity(), BLACK, head=None, head_pixels=nothing).psnr_head_alone is None


def test_the_head_is_shown_where_its_faces_are_nearest():
    # Two squares in front of a camera that looks along z: the nearer one hides the left half of the farther one.
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    far = np.column_stack((0.8 * corners, np.full(4, 2.0)))
    near = np.column_stack((0.2 * corners - (0.2, 0.0), np.full(4, 1.0)))
    square = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = TriangleMesh(np.concatenate((far, near)), np.concatenate((square, square + 4)))
    camera = Camera(np.array([[50.0, 0, 25], [0, 50, 25], [0, 0, 1]]), np.eye(4), 50, 50)
    head = head_shown(mesh, np.array([True, True, False, False]), camera).numpy()
    assert head[25, 35] and not head[25, 15] and not head[25, 2]
    assert not head_shown(mesh, np.array([False] * 4), camera).any()
    assert head_shown(mesh, np.array([True] * 4), camera).numpy()[25, 15]


def test_means_are_over_the_views_that_have_a_figure():
    views = {"a": ViewQuality(20.0, 30.0, 0.9, 25.0), "b": ViewQuality(22.0, 32.0, 0.8, None)}
    assert mean_quality(views) == {"psnr": 21.0, "psnr_image": 31.0, "ssim": pytest.approx(0.85), "psnr_head": 25.0}
    assert mean_quality({}) == {}


class MeanDifference(PerceptualDistance):
    """Stands for a metric; blind to what it is not shown."""

    name = "mean difference"

    def distance(self, x, y):
        return (x - y).abs().mean((1, 2, 3))


def test_perceptual_distance_and_ssim_of_the_crop_see_the_crop_alone():
    it, metric = view(), MeanDifference()
    image = it.composited(BLACK).clone()
    image[60:] = 1.0  # below the head's box
    quality = view_quality(it, image, it.opacity(), BLACK, head=(8, 4, 56, 44), metric=metric)
    assert (quality.ssim_head, quality.perceptual_head) == (pytest.approx(1.0), 0.0)
    assert quality.ssim < 0.95 and quality.perceptual > 0.1
    small = view_quality(it, image, it.opacity(), BLACK, head=(8, 4, 39, 44), metric=metric)
    assert small.perceptual_head is None and small.psnr_head is not None
    assert view_quality(it, image, it.opacity(), BLACK, head=None).perceptual is None


def test_eight_bits():
    np.testing.assert_array_equal(eight_bit(torch.tensor([-1.0, 0.0, 0.5, 1.0, 9.0])), [0, 0, 128, 255, 255])
