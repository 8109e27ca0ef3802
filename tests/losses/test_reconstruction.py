"""The reconstruction loss: its terms, their weights, and what is left out."""

from __future__ import annotations

import math

import pytest
import torch

from avatar.losses.image_similarity import ssim
from avatar.losses.perceptual import PerceptualDistance
from avatar.losses.reconstruction import ReconstructionWeights, Target, reconstruction_loss
from avatar.rendering.avatar_view import Rendering
from smplxpp.core.errors import InputError


class MeanDifference(PerceptualDistance):
    """Stands for a metric: mean of the difference of images in [-1, 1]."""

    name = "difference"

    def distance(self, x, y):
        return (x - y).abs().mean((1, 2, 3))


def pair(size: int = 40) -> tuple[Rendering, Target]:
    random = torch.Generator().manual_seed(0)
    image, real = (torch.rand(size, size, 3, generator=random) for _ in range(2))
    alpha, mask = (torch.rand(size, size, generator=random) for _ in range(2))
    normals = torch.randn(size, size, 3, generator=random)
    known = torch.nn.functional.normalize(torch.randn(size, size, 3, generator=random), dim=-1)
    known[: size // 2] = 0.0
    return Rendering(image, alpha, normals), Target(real, mask, known.half())


def test_the_weighted_sum_of_all_terms():
    rendering, target = pair()
    weights = ReconstructionWeights(dssim=0.3, perceptual=0.7, normal=0.11, alpha=0.5, l2=3.0)
    total, terms = reconstruction_loss(rendering, target, weights, perceptual=MeanDifference())
    l1 = (rendering.image - target.image).abs().mean()
    known = target.normals.float()[20:]
    expected = {
        "l1": float(l1),
        "l2": float((rendering.image - target.image).square().mean()),
        "dssim": 1.0 - float(ssim(rendering.image, target.image)),
        "alpha": float((rendering.alpha - target.alpha).abs().mean()),
        "perceptual": 2.0 * float(l1),
        "normal": float((rendering.normals[20:] - known).abs().sum(-1).mean()),
        "psnr_crop": -10.0 * math.log10(float((rendering.image - target.image).square().mean())),
    }
    assert terms == pytest.approx(expected, rel=1e-5)
    sum_of = expected["l1"] + 3.0 * expected["l2"] + 0.3 * expected["dssim"] + 0.5 * expected["alpha"]
    assert float(total) == pytest.approx(sum_of + 0.7 * expected["perceptual"] + 0.11 * expected["normal"], rel=1e-5)


def test_the_defaults_are_the_papers():
    weights = ReconstructionWeights()
    assert (weights.dssim, weights.perceptual, weights.normal) == (0.2, 0.01, 0.02)
    assert weights.alpha == weights.l2 == 0.0


def test_equal_images_cost_nothing():
    rendering, _ = pair()
    target = Target(rendering.image, rendering.alpha, rendering.normals)
    total, terms = reconstruction_loss(rendering, target, ReconstructionWeights(alpha=1.0), perceptual=MeanDifference())
    assert float(total) == pytest.approx(0.0, abs=1e-6) and terms["psnr_crop"] == pytest.approx(120.0)


def test_terms_without_what_they_need_are_left_out():
    rendering, target = pair()
    assert "perceptual" not in reconstruction_loss(rendering, target, ReconstructionWeights())[1]
    bare = Target(target.image, target.alpha)
    assert "normal" not in reconstruction_loss(rendering, bare, ReconstructionWeights())[1]
    nowhere = Target(target.image, target.alpha, torch.zeros_like(target.normals))
    assert "normal" not in reconstruction_loss(rendering, nowhere, ReconstructionWeights())[1]
    small, small_target = pair(31)
    terms = reconstruction_loss(small, small_target, ReconstructionWeights(), perceptual=MeanDifference())[1]
    assert "perceptual" not in terms
    none = ReconstructionWeights(dssim=0.0, perceptual=0.0, normal=0.0)
    assert set(reconstruction_loss(rendering, target, none, perceptual=MeanDifference())[1]) == {"l1", "psnr_crop"}


def test_gradients_go_to_image_opacity_and_normals():
    rendering, target = pair()
    leaves = [value.requires_grad_() for value in (rendering.image, rendering.alpha, rendering.normals)]
    total, _ = reconstruction_loss(rendering, target, ReconstructionWeights(alpha=0.1), perceptual=MeanDifference())
    total.backward()
    assert all(leaf.grad.abs().sum() > 0 for leaf in leaves)
    assert not rendering.normals.grad[:20].any()  # where the target has none


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["dssim", "perceptual", "normal", "alpha", "l2"])
def test_weights_have_to_be_numbers_from_zero_on(name, value):
    with pytest.raises(InputError, match=name):
        ReconstructionWeights(**{name: value})
