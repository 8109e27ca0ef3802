"""Layers of the StyleUNet against slow references and the identities that the filters must hold."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from avatar.models.networks.stylegan2_layers import (
    GAIN,
    ConvLayer,
    EqualizedLinear,
    FirFilter,
    JoiningConv,
    ModulatedWeight,
    StyledConv,
    ToMaps,
    demodulate,
)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def test_filter_is_separable_binomial_and_sums_to_gain():
    kernel = FirFilter(gain=4.0).kernel[0, 0]
    taps = torch.tensor([1.0, 3.0, 3.0, 1.0]) / 8
    torch.testing.assert_close(kernel, 4 * torch.outer(taps, taps))


@pytest.mark.parametrize("operation", ["halve", "enlarge"])
def test_constant_image_stays_constant_inside(operation):
    image = torch.full((1, 3, 8, 8), 2.5)
    filtered = getattr(FirFilter(gain=4.0 if operation == "enlarge" else 1.0), operation)(image)
    torch.testing.assert_close(filtered[:, :, 1:-1, 1:-1], torch.full_like(filtered, 2.5)[:, :, 1:-1, 1:-1])


def test_every_pixel_gives_its_brightness_once():
    # Each input pixel away from the border adds the filter's sum to the doubled image, whichever phase it is in.
    filter_ = FirFilter(gain=4.0)
    for row, column in ((3, 3), (3, 4), (4, 4)):
        impulse = torch.zeros(1, 1, 8, 8)
        impulse[0, 0, row, column] = 1.0
        assert filter_.enlarge(impulse).sum().item() == pytest.approx(4.0)


def test_enlarge_is_bilinear_and_halve_is_antialiased_resizing_inside():
    image = torch.randn(2, 3, 8, 8)
    doubled = F.interpolate(image, scale_factor=2.0, mode="bilinear")
    torch.testing.assert_close(FirFilter(gain=4.0).enlarge(image)[:, :, 1:-1, 1:-1], doubled[:, :, 1:-1, 1:-1])
    halved = F.interpolate(image, scale_factor=0.5, mode="bilinear", antialias=True)
    torch.testing.assert_close(FirFilter().halve(image)[:, :, 1:-1, 1:-1], halved[:, :, 1:-1, 1:-1])


@pytest.mark.parametrize("padding", [1, 2])
def test_filter_gradient(padding):
    filter_ = FirFilter(gain=3.0)
    filter_.kernel = filter_.kernel.to(torch.float64)
    image = torch.randn(2, 3, 6, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: filter_(x, padding=padding), (image,))


@torch.no_grad()
def test_modulated_weights_against_loops():
    layer = ModulatedWeight(3, 4, 3, 5)
    style = torch.randn(5)
    weight = demodulate(layer(style))
    s = [
        sum(float(layer.affine.weight[i, k] * style[k]) for k in range(5)) / math.sqrt(5) + float(layer.affine.bias[i])
        for i in range(3)
    ]
    for o in range(4):
        scaled = [[[s[i] * float(layer.weight[o, i, r, c]) for c in range(3)] for r in range(3)] for i in range(3)]
        norm = math.sqrt(sum(v * v for plane in scaled for row in plane for v in row) + 1e-8)
        torch.testing.assert_close(weight[o], torch.tensor(scaled) / norm, rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_styled_conv_against_loops():
    layer = StyledConv(2, 3, 4, noise_size=5)
    layer.bias.normal_()
    layer.noise_strength.fill_(0.3)
    x, style = torch.randn(2, 5, 5), torch.randn(4)
    weight = demodulate(layer.modulated(style))
    expected = torch.zeros(3, 5, 5)
    for o in range(3):
        for r in range(5):
            for c in range(5):
                value = layer.bias[o] + 0.3 * layer.noise[0, 0, r, c]
                for i in range(2):
                    for dr in (-1, 0, 1):
                        for dc in (-1, 0, 1):
                            if 0 <= r + dr < 5 and 0 <= c + dc < 5:
                                value = value + GAIN * weight[o, i, dr + 1, dc + 1] * x[i, r + dr, c + dc]
                expected[o, r, c] = value if value > 0 else 0.2 * value
    torch.testing.assert_close(layer(x[None], style)[0], expected, rtol=1e-4, atol=1e-5)


def test_upsampling_conv_is_conv_of_the_doubled_image():
    # Zeros in between, convolution, low-pass filter: away from the border their order does not matter.
    layer = StyledConv(3, 2, 4, up=True)
    x, style = torch.randn(1, 3, 8, 8), torch.randn(4)
    weight = demodulate(layer.modulated(style))
    smooth = FirFilter(gain=4.0).enlarge(x)
    # A transposed convolution turns the kernel round.
    expected = F.leaky_relu(GAIN * F.conv2d(smooth, weight.flip(2, 3), padding=1), 0.2)
    torch.testing.assert_close(layer(x, style)[..., 3:-3, 3:-3], expected[..., 3:-3, 3:-3], rtol=1e-4, atol=1e-5)


def test_to_maps_gives_each_pixel_its_own_block():
    layer = ToMaps(3, 2, 4, zero=False)
    x, style = torch.zeros(1, 3, 4, 4), torch.randn(4)
    x[0, :, 1, 2] = torch.randn(3)
    maps = layer(x, style)
    expected = torch.einsum("i,oirc->orc", x[0, :, 1, 2], layer.modulated(style)) / math.sqrt(3)
    torch.testing.assert_close(maps[0, :, 2:4, 4:6], expected)
    maps[0, :, 2:4, 4:6] = 0
    assert maps.abs().max() == 0


def test_joining_conv_is_the_conv_of_both():
    layer = JoiningConv(4)
    with torch.no_grad():
        layer.bias.normal_()
    x, y = torch.randn(3, 4, 6, 6), torch.randn(1, 4, 6, 6)
    whole = ConvLayer(8, 4)
    whole.load_state_dict(layer.state_dict())
    expected = whole(torch.cat([x, y.expand(3, -1, -1, -1)], dim=1))
    torch.testing.assert_close(layer(x, layer.skip(y)), expected)


def test_signals_keep_their_variance():
    # What the equalised scale, the gain and demodulation are for.
    x = torch.randn(8, 64, 32, 32)
    style = torch.ones(16)
    for layer in (ConvLayer(64, 64), ConvLayer(64, 64, kernel=1)):
        assert layer(x).square().mean().item() == pytest.approx(1.0, rel=0.15)
    assert StyledConv(64, 64, 16)(x, style).square().mean().item() == pytest.approx(1.0, rel=0.15)


def test_rate_multiplies_the_step_and_not_the_start():
    torch.manual_seed(1)
    plain = EqualizedLinear(6, 3)
    torch.manual_seed(1)
    slow = EqualizedLinear(6, 3, lr_multiplier=0.01)
    x = torch.randn(6)
    torch.testing.assert_close(plain(x), slow(x))
    plain(x).sum().backward()
    slow(x).sum().backward()
    torch.testing.assert_close(slow.weight.grad, 0.01 * plain.weight.grad)


def test_half_precision_autocast_runs_forward_and_backward():
    layer = StyledConv(4, 4, 4, up=True)
    x = torch.randn(1, 4, 8, 8, requires_grad=True)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = layer(x, torch.ones(4))
    y.float().square().mean().backward()
    assert y.dtype == torch.bfloat16 and x.grad.dtype == torch.float32 and x.grad.abs().sum() > 0
