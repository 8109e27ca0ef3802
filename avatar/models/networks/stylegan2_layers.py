"""Layers of StyleGAN2 (Karras et al. 2020) in plain torch: equalised, modulated and filtered convolutions.

Weights are drawn from N(0, 1) and scaled by `1 / sqrt(fan in)` when used (equalised learning rate, Karras et al. 2018).
Activations are `leaky_relu(x, 0.2)` with a gain of `sqrt(2)`, which is folded into the weights: they are small, the
images are not.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

SLOPE = 0.2
GAIN = math.sqrt(2.0)
DEMODULATION_EPS = 1e-8
FIR_TAPS = (1.0, 3.0, 3.0, 1.0)
"""The low-pass filter of StyleGAN2 along one axis, before it is normalised to sum 1."""


class _SymmetricFilter(torch.autograd.Function):
    """Depthwise filter whose adjoint is the same filter with the complementary padding.

    Torch's own gradient of a depthwise convolution runs a kernel that is several times slower on a CPU.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, kernel: Tensor, padding: int) -> Tensor:
        ctx.save_for_backward(kernel)
        ctx.padding = padding
        weight = kernel.to(image.dtype).expand(image.shape[1], -1, -1, -1)
        return F.conv2d(image, weight, padding=padding, groups=image.shape[1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (kernel,) = ctx.saved_tensors
        # A symmetric kernel is its own mirror image, so the adjoint is a convolution too; its padding restores the
        # size.
        complementary = kernel.shape[-1] - 1 - ctx.padding
        return _SymmetricFilter.apply(gradient, kernel, complementary), None, None


class FirFilter(nn.Module):
    """The separable low-pass filter [1, 3, 3, 1] / 8 on images (B, C, H, W) that are zero outside.

    Args:
        gain: multiplies the filter; 4 keeps the brightness of an image that is doubled with zeros in between.
    """

    kernel: Tensor

    def __init__(self, *, gain: float = 1.0) -> None:
        super().__init__()
        taps = np.array(FIR_TAPS, dtype=np.float32)
        # The outer product of the taps with themselves, normalised to sum `gain`.
        kernel = np.outer(taps, taps) * np.float32(gain / sum(FIR_TAPS) ** 2)
        self.register_buffer("kernel", torch.tensor(kernel[None, None]), persistent=False)

    def forward(self, image: Float[Tensor, "B C H W"], *, padding: int) -> Float[Tensor, "B C h w"]:
        """Filter images; each side becomes `2 padding - 3` pixels longer."""
        return _SymmetricFilter.apply(image, self.kernel, padding)

    def halve(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C h w"]:
        """Filter images, then keep every second pixel."""
        return F.conv2d(image, self._weight(image), stride=2, padding=1, groups=image.shape[1])

    def enlarge(self, image: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C h w"]:
        """Double images with zeros in between, then filter them; with gain 4 this is bilinear interpolation inside."""
        return F.conv_transpose2d(image, self._weight(image), stride=2, padding=1, groups=image.shape[1])

    def _weight(self, image: Tensor) -> Tensor:
        return self.kernel.to(image.dtype).expand(image.shape[1], -1, -1, -1)


def _normal(*size: int, over: float = 1.0) -> Tensor:
    """Draw from N(0, 1 / over^2); on the device "meta", whose tensors have no values, draw nothing.

    Torch's draws there import its compiler, which takes 1.5 s of every process that reads or foresees a teacher.
    """
    if torch.get_default_device().type == "meta":
        return torch.empty(size)
    drawn = torch.randn(size)
    return drawn if over == 1.0 else drawn / over


class EqualizedLinear(nn.Module):
    """`y = r (W x / sqrt(fan in) + b)` with W ~ N(0, 1 / r^2): r is the layer's learning-rate multiplier."""

    def __init__(self, inputs: int, outputs: int, *, bias: float = 0.0, lr_multiplier: float = 1.0) -> None:
        super().__init__()
        self.weight = nn.Parameter(_normal(outputs, inputs, over=lr_multiplier))
        self.bias = nn.Parameter(torch.full((outputs,), bias))
        self.lr_multiplier = lr_multiplier
        self.scale = 1.0 / math.sqrt(inputs)

    def forward(self, x: Float[Tensor, "*B I"]) -> Float[Tensor, "*B O"]:
        """Return the layer's outputs for a batch of vectors."""
        y = F.linear(x * self.scale, self.weight, self.bias)
        return y if self.lr_multiplier == 1.0 else self.lr_multiplier * y


class _EqualizedConv(nn.Module):
    """Weights and bias of a convolution with an activation behind it."""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_normal(outputs, inputs, kernel, kernel))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale = GAIN / math.sqrt(inputs * kernel**2)


class ConvLayer(_EqualizedConv):
    """Equalised convolution and activation; with `down` the image is filtered and halved between them."""

    def __init__(self, inputs: int, outputs: int, *, kernel: int = 3, down: bool = False) -> None:
        super().__init__(inputs, outputs, kernel)
        self.filter = FirFilter() if down else None

    def forward(self, x: Float[Tensor, "B I H W"]) -> Float[Tensor, "B O h w"]:
        """Return the activations; h and w are H and W, or half of them with `down`."""
        # Equalised learning rate: stored weights have unit variance, used ones 2 / fan in (He), with the gain's
        # square 2.
        weight = self.weight * self.scale
        reach = weight.shape[-1] // 2
        if self.filter is None:
            x = F.conv2d(x, weight, self.bias, padding=reach)
        else:
            # Low-pass filter, then a convolution with stride 2; the filter's padding makes the output half the side.
            x = F.conv2d(self.filter(x, padding=reach + 1), weight, self.bias, stride=2)
        return F.leaky_relu(x, SLOPE, inplace=True)


class JoiningConv(_EqualizedConv):
    """`forward(x, skip(y)) = ConvLayer(cat(x, y))`: the half that sees y is computed once and used for many x."""

    def __init__(self, channels: int) -> None:
        super().__init__(2 * channels, channels, 3)

    def skip(self, y: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Return the half of the convolution that sees y, with the bias."""
        return F.conv2d(y, self.weight.chunk(2, dim=1)[1] * self.scale, self.bias, padding=1)

    def forward(self, x: Float[Tensor, "#B C H W"], skip: Float[Tensor, "#B C H W"]) -> Float[Tensor, "_ C H W"]:
        """Join x to a skip at hand; one of the two may have a batch of 1."""
        x = F.conv2d(x, self.weight.chunk(2, dim=1)[0] * self.scale, padding=1)
        return F.leaky_relu(x + skip, SLOPE, inplace=True)


class ModulatedWeight(nn.Module):
    """Weights of a convolution scaled by a style, `w'_oikl = s_i w_oikl` with `s = A style`.

    The style is one vector for the whole batch, as the avatar's networks use it, so that the result is an ordinary
    filter bank: (outputs, inputs, kernel, kernel).
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, style_size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(_normal(outputs, inputs, kernel, kernel))
        self.affine = EqualizedLinear(style_size, inputs, bias=1.0)

    def forward(self, style: Float[Tensor, " S"]) -> Float[Tensor, "O I K K"]:
        """Return the weights in a style."""
        return self.weight * self.affine(style)[:, None, None]


def demodulate(weight: Float[Tensor, "O I K K"]) -> Float[Tensor, "O I K K"]:
    """Return filters of unit norm, `w'' = w' / sqrt(sum_ikl w'_oikl^2 + 1e-8)` (Karras et al. 2020, equation 3)."""
    return weight * torch.rsqrt(weight.square().sum((1, 2, 3), keepdim=True) + DEMODULATION_EPS)


class StyledConv(nn.Module):
    """Modulated 3 x 3 convolution, fixed noise, bias and activation; with `up` the image is doubled first.

    Doubling is a transposed convolution with stride 2 followed by the low-pass filter. The noise is one stored image of
    N(0, 1) whose strength is learnt from zero: detail that stays where it is, hence no flicker.

    Args:
        inputs: channels of the input.
        outputs: channels of the output.
        style_size: length of the style.
        up: double the image.
        noise_size: side of the output in pixels, if noise is to be added.
    """

    noise: Tensor | None

    def __init__(
        self, inputs: int, outputs: int, style_size: int, *, up: bool = False, noise_size: int | None = None
    ) -> None:
        super().__init__()
        self.modulated = ModulatedWeight(inputs, outputs, 3, style_size)
        self.bias = nn.Parameter(torch.zeros(outputs))
        # The gain of the activation, and that of the zeros in between, ride on the filter where there is one.
        self.filter = FirFilter(gain=4.0 * GAIN) if up else None
        if noise_size is not None:
            self.register_buffer("noise", _normal(1, 1, noise_size, noise_size))
            self.noise_strength = nn.Parameter(torch.zeros(()))
        else:
            self.noise = None

    def forward(self, x: Float[Tensor, "B I H W"], style: Float[Tensor, " S"]) -> Float[Tensor, "B O h w"]:
        """Return the activations; h and w are H and W, or twice as much with `up`."""
        # Filters of unit norm keep the features' variance whatever the style, in the place of a normalisation layer.
        weight = demodulate(self.modulated(style))
        if self.filter is None:
            x = F.conv2d(x, weight * GAIN, self.bias, padding=1)
        else:
            # Zeros in between, convolved; the filter then removes the copies of the spectrum that the zeros cause.
            x = F.conv_transpose2d(x, weight.transpose(0, 1), stride=2)
            x = self.filter(x, padding=1) + self.bias[:, None, None].to(x.dtype)
        if self.noise is not None:
            x = x + (self.noise_strength * self.noise).to(x.dtype)
        return F.leaky_relu(x, SLOPE, inplace=True)


class ToMaps(nn.Module):
    """Takes feature maps to output maps of twice the side.

    Each feature pixel gives a block of 2 x 2 output pixels by a modulated linear map: four Haar coefficients and the
    inverse transform, as Animatable Gaussians has it, up to an orthonormal change of the weights.

    Args:
        inputs: channels of the input.
        outputs: channels of the output.
        style_size: length of the style.
        zero: start from weights of zero: the maps are zero until something is learnt.
    """

    def __init__(self, inputs: int, outputs: int, style_size: int, *, zero: bool) -> None:
        super().__init__()
        self.modulated = ModulatedWeight(inputs, outputs, 2, style_size)
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale = 1.0 / math.sqrt(inputs)
        if zero:
            nn.init.zeros_(self.modulated.weight)

    def forward(self, x: Float[Tensor, "B I H W"], style: Float[Tensor, " S"]) -> Float[Tensor, "B O h w"]:
        """Return the maps of twice the side."""
        weight = self.modulated(style) * self.scale
        return F.conv_transpose2d(x, weight.transpose(0, 1), self.bias, stride=2)
