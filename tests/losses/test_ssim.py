from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar.losses.image_similarity import ssim, ssim_map, ssim_map_reference, ssim_reference
from smplxpp.core.errors import InputError
from smplxpp.native import _FEATURES, LEVELS, _cpu_features, native_library
from tests.pretended_cuda import CountedWaits, pretended_cuda

SHAPES = [(37, 53, 3), (24, 270, 3), (140, 20, 1), (3, 2, 5), (20, 121, 7), (1, 1, 1), (11, 11, 3), (2, 24, 30, 2)]


def pair(shape: tuple[int, ...], noise: float = 0.1, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth image and a noisy copy of it, in [0, 1]."""
    rng = torch.Generator().manual_seed(seed)
    *batch, H, W, C = shape
    coarse = torch.rand((int(np.prod(batch)), C, H // 8 + 2, W // 8 + 2), generator=rng)
    x = torch.nn.functional.interpolate(coarse, size=(H, W), mode="bilinear").permute(0, 2, 3, 1).reshape(shape)
    return x.contiguous(), (x + noise * torch.randn(shape, generator=rng)).clamp(0, 1)


def gradients(function, x: torch.Tensor, y: torch.Tensor, **options) -> tuple[torch.Tensor, ...]:
    x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
    value = function(x, y, **options)
    value.backward(torch.linspace(-1, 1, value.numel(), dtype=x.dtype).reshape(value.shape) if value.dim() else None)
    return value.detach(), x.grad, y.grad


def assert_equal_to_reference(native, reference, tolerance: float = 1e-5) -> None:
    for got, truth in zip(native, reference, strict=True):
        assert (got - truth).abs().max() <= tolerance * max(1e-8, float(truth.abs().max()))


@pytest.mark.parametrize("padding", ["zero", "valid"])
@pytest.mark.parametrize("shape", SHAPES)
def test_mean_and_gradients_equal_the_reference(shape, padding):
    x, y = pair(shape)
    mask = torch.rand(shape[-3:-1], generator=torch.Generator().manual_seed(1))
    if padding == "valid" and min(shape[-3:-1]) < 11:
        return
    for m in (None, mask):
        got = gradients(ssim, x, y, mask=m, padding=padding)
        truth = gradients(ssim_reference, x.double(), y.double(), mask=m, padding=padding)
        assert_equal_to_reference(got, truth)


@pytest.mark.parametrize("padding", ["zero", "valid"])
def test_map_and_its_gradient_equal_the_reference(padding):
    x, y = pair((50, 140, 3))
    got = gradients(ssim_map, x, y, padding=padding)
    truth = gradients(ssim_map_reference, x.double(), y.double(), padding=padding)
    assert got[0].shape == truth[0].shape
    assert_equal_to_reference(got, truth, 2e-5)


@pytest.mark.parametrize("padding", ["zero", "valid"])
def test_a_gpu_blurs_along_one_axis_after_the_other_and_gets_the_same(padding):
    x, y = (image.double() for image in pair((2, 23, 31, 3)))
    truth = gradients(ssim_map_reference, x, y, padding=padding)
    with pretended_cuda(), CountedWaits() as counted:
        images = [image.to("cuda").requires_grad_() for image in (x, y)]
        value = ssim_map(*images, padding=padding)
        weight = torch.linspace(-1, 1, value.numel(), dtype=x.dtype).reshape(value.shape).to("cuda")
        value.backward(weight)
        found = [one.cpu() for one in (value.detach(), images[0].grad, images[1].grad)]
    assert_equal_to_reference(found, truth, 1e-10)
    assert counted.count == 0 and counted.calls["aten.convolution.default"] == 4  # two forward, two backward


def test_only_the_asked_gradient_is_given():
    x, y = pair((30, 30, 3))
    both = gradients(ssim, x, y)
    for k, images in enumerate([(x.clone().requires_grad_(), y), (x, y.clone().requires_grad_())]):
        ssim(*images).backward()
        torch.testing.assert_close(images[k].grad, both[1 + k], rtol=1e-4, atol=1e-9)
        assert images[1 - k].grad is None


@pytest.mark.parametrize("level", LEVELS)
def test_every_instruction_set_gives_the_same_within_rounding(level, monkeypatch):
    if not _FEATURES[level] <= _cpu_features():
        pytest.skip(f"this CPU has no {level}")
    library = native_library(level)
    monkeypatch.setattr("avatar.losses.image_similarity.native_library", lambda: library)
    x, y = pair((70, 90, 3))
    assert_equal_to_reference(gradients(ssim, x, y), gradients(ssim_reference, x.double(), y.double()))


def test_any_number_of_threads_gives_the_same_bits():
    x, y = pair((2, 300, 290, 3))
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(gradients(ssim, x, y))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_gradcheck_of_the_reference():
    x, y = (v.double().requires_grad_() for v in pair((3, 4, 1)))
    assert torch.autograd.gradcheck(lambda a, b: ssim(a, b, padding="zero"), (x, y))


def test_value_stored_from_scikit_image():
    """structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1) of 0.26."""
    rows, cols = np.mgrid[:40, :50]
    x = 0.5 + 0.4 * np.sin(0.3 * rows + 0.1 * cols)
    y = 0.5 + 0.4 * np.sin(0.3 * rows + 0.1 * cols + 0.5) * np.cos(0.02 * cols)
    images = (torch.tensor(v[..., None], dtype=torch.float32) for v in (x, y))
    assert float(ssim(*images, padding="valid")) == pytest.approx(0.7231354550, abs=1e-6)


def test_invariants():
    x, y = pair((33, 44, 3))
    assert float(ssim(x, x)) == pytest.approx(1.0, abs=1e-6)
    assert float(ssim(x, y)) == pytest.approx(float(ssim(y, x)), abs=1e-6)
    for moved in (lambda v: v.flip(0), lambda v: v.flip(1), lambda v: v.transpose(0, 1), lambda v: v.flip(2)):
        assert float(ssim(moved(x), moved(y))) == pytest.approx(float(ssim(x, y)), abs=1e-6)
    assert float(ssim(x, y, mask=torch.full((33, 44), 0.3))) == pytest.approx(float(ssim(x, y)), abs=1e-6)
    half = torch.zeros(33, 44)
    half[:, :20] = 1
    assert float(ssim(x, y, mask=half)) == pytest.approx(float(ssim_map(x, y)[:, :20].mean()), abs=1e-6)


def test_gradient_flows_through_what_comes_before_and_after():
    x, y = pair((20, 20, 3))
    x.requires_grad_()
    (3 * ssim(2 * x, y) + 1).backward()
    z = (2 * x.detach()).requires_grad_()
    ssim(z, y).backward()
    torch.testing.assert_close(x.grad, 6 * z.grad)


def test_without_grad_nothing_is_kept():
    x, y = pair((20, 20, 3))
    x.requires_grad_()
    with torch.no_grad():
        assert not ssim(x, y).requires_grad


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
def test_broken_pixels_do_not_crash(bad):
    x, y = pair((40, 40, 3))
    x[20, 20, 1] = bad
    got = gradients(ssim, x, y)
    assert torch.isfinite(got[1][:5]).all()
    if bad != bad:
        assert torch.isnan(got[0])


@given(st.tuples(*[st.integers(1, 40)] * 2, st.integers(1, 4)), st.integers(0, 5))
@settings(max_examples=20, deadline=None)
def test_any_size(shape, seed):
    x, y = pair(shape, seed=seed)
    assert float(ssim(x, y)) == pytest.approx(float(ssim_reference(x.double(), y.double())), abs=1e-5)


@pytest.mark.parametrize(
    ("x", "y", "options", "words"),
    [
        ((8, 8, 3), (8, 9, 3), {}, "one shape"),
        ((8, 8), (8, 8), {}, r"\(H, W, C\)"),
        ((0, 8, 3), (0, 8, 3), {}, "at least 1 x 1"),
        ((8, 8, 3), (8, 8, 3), {"padding": "valid"}, "at least 11 x 11"),
        ((8, 8, 3), (8, 8, 3), {"padding": "same"}, "'zero' or 'valid'"),
        ((8, 8, 3), (8, 8, 3), {"mask": torch.ones(8, 9)}, r"shape \(8, 8\)"),
        ((8, 8, 3), (8, 8, 3), {"mask": torch.zeros(8, 8)}, "some weight above 0"),
    ],
)
def test_bad_input_is_refused(x, y, options, words):
    with pytest.raises(InputError, match=words):
        ssim(torch.rand(x), torch.rand(y), **options)


def test_other_types_are_refused():
    with pytest.raises(InputError, match="Divide 8-bit"):
        ssim(torch.zeros(8, 8, 3, dtype=torch.uint8), torch.zeros(8, 8, 3, dtype=torch.uint8))
    with pytest.raises(InputError, match="one shape and type"):
        ssim(torch.rand(8, 8, 3), torch.rand(8, 8, 3).double())
