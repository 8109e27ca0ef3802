"""Measure the similarity of images: PSNR, and SSIM by a readable reference or a fused native kernel with gradients.

SSIM (Wang et al. 2004) at a pixel, from Gaussian-weighted means over its 11x11 window (sigma 1.5):

    SSIM = (2 mu_x mu_y + C1) (2 cov_xy + C2) / ((mu_x^2 + mu_y^2 + C1) (var_x + var_y + C2)),  C1 = 0.01^2, C2 = 0.03^2

with biased variances, for images in [0, 1], each channel separately. `padding="zero"` takes pixels outside of the image
as 0, like the code of 3D Gaussian Splatting; `"valid"` uses only windows that lie within the image.
"""

from __future__ import annotations

import ctypes
import math
from functools import cache
from typing import Any, overload

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor

from avatar.rendering.memory import pooled_empty
from smplxpp.core.errors import InputError
from smplxpp.native import address, check_size, native_library, thread_count

WINDOW = 11
"""Side of the window, pixels."""
_C1, _C2 = 0.01**2, 0.03**2
_BORDER = {"zero": 0, "valid": WINDOW // 2}


def ssim(
    x: Float[Tensor, "*B H W C"],
    y: Float[Tensor, "*B H W C"],
    *,
    mask: Shaped[Tensor, "*B H W"] | Shaped[Tensor, "H W"] | None = None,
    padding: str = "zero",
) -> Float[Tensor, ""]:
    """Return the mean structural similarity of two images over pixels, channels and batch; 1 where they are equal.

    float32 tensors on the CPU go through the fused kernel, which gives the same bits at any number of threads. Those on
    a GPU are blurred along one axis after the other, all others go through `ssim_reference`.

    Args:
        x: one image or B of them, in [0, 1]. Gradients flow to it where it requires them.
        y: images of the same shape and type; gradients flow to them in the same way.
        mask: weights >= 0 of one image or of each: `sum(mask * SSIM) / (C sum(mask))`. Windows are not masked, so
            composite both images on one background first. No gradient flows to the mask.
        padding: "zero" or "valid".

    Raises:
        InputError: different shapes, types or devices; a mask without weight; "valid" on images under 11 pixels.
    """
    if not _native(x):
        return _mean_of_map(ssim_map(x, y, padding=padding), x, y, mask, padding)
    x, y, mask = _checked(x, y, mask, padding)
    return _SsimMean.apply(x, y, mask, _BORDER[padding], torch.is_grad_enabled())


def ssim_map(
    x: Float[Tensor, "*B H W C"], y: Float[Tensor, "*B H W C"], *, padding: str = "zero"
) -> Float[Tensor, "*B h w C"]:
    """Return the similarity at every pixel and channel; with "valid" the map is 10 pixels smaller along each axis.

    Arguments and errors are those of `ssim`.
    """
    if not _native(x):
        return (_ssim_map_separable if x.is_cuda else ssim_map_reference)(x, y, padding=padding)
    batched = x.dim() == 4
    x, y, _ = _checked(x, y, None, padding)
    value = _SsimMap.apply(x, y, _BORDER[padding])
    return value if batched else value[0]


def ssim_reference(
    x: Float[Tensor, "*B H W C"],
    y: Float[Tensor, "*B H W C"],
    *,
    mask: Shaped[Tensor, "*B H W"] | Shaped[Tensor, "H W"] | None = None,
    padding: str = "zero",
) -> Float[Tensor, ""]:
    """Return `ssim` in plain torch, in the images' own precision and on their device."""
    return _mean_of_map(ssim_map_reference(x, y, padding=padding), x, y, mask, padding)


def ssim_map_reference(
    x: Float[Tensor, "*B H W C"], y: Float[Tensor, "*B H W C"], *, padding: str = "zero"
) -> Float[Tensor, "*B h w C"]:
    """Return `ssim_map` in plain torch by its definition, in the images' own precision and on their device."""
    batched = x.dim() == 4
    x, y, _ = _checked(x, y, None, padding)
    C = x.shape[-1]
    # Separable Gaussian window, then local means, variances and covariance.
    g = _taps(x.device, x.dtype)
    kernel = torch.outer(g, g).expand(C, 1, WINDOW, WINDOW)

    def blur(v: Tensor) -> Tensor:
        return F.conv2d(v, kernel, groups=C, padding=WINDOW // 2 if padding == "zero" else 0)

    x, y = x.permute(0, 3, 1, 2), y.permute(0, 3, 1, 2)
    value = _similarity(*(blur(moment) for moment in (x, y, x * x, y * y, x * y))).permute(0, 2, 3, 1)
    return value if batched else value[0]


def _ssim_map_separable(x: Tensor, y: Tensor, *, padding: str) -> Tensor:
    """Return `ssim_map_reference` by two convolutions of 11 taps for all moments, where that has five of 121."""
    batched = x.dim() == 4
    x, y, _ = _checked(x, y, None, padding)
    x, y = x.permute(0, 3, 1, 2), y.permute(0, 3, 1, 2)
    moments = torch.stack([x, y, x * x, y * y, x * y])
    blurred = _Blur.apply(moments.flatten(0, 2)[:, None], WINDOW // 2 if padding == "zero" else 0)
    value = _similarity(*blurred[:, 0].unflatten(0, moments.shape[:3])).permute(0, 2, 3, 1)
    return value if batched else value[0]


def _similarity(mu_x: Tensor, mu_y: Tensor, square_x: Tensor, square_y: Tensor, product: Tensor) -> Tensor:
    # Biased moments, E[x^2] - E[x]^2; rounding may leave a variance slightly below 0, which C2 covers.
    var_x, var_y, cov = square_x - mu_x**2, square_y - mu_y**2, product - mu_x * mu_y
    return (2 * mu_x * mu_y + _C1) * (2 * cov + _C2) / ((mu_x**2 + mu_y**2 + _C1) * (var_x + var_y + _C2))


@cache
def _taps(device: torch.device, dtype: torch.dtype) -> Float[Tensor, " 11"]:
    """Return the window along one axis; made once, because a GPU would wait for its copy in every step."""
    k = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    g = torch.exp(-(k**2) / (2 * 1.5**2))
    return (g / g.sum()).to(device, dtype)


class _Blur(torch.autograd.Function):
    """Blurs planes (N, 1, H, W) by the window, whose adjoint is the same blur with the complementary padding."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, padding: int) -> Tensor:
        ctx.padding = padding
        return _blurred(planes, padding)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _blurred(grad, WINDOW - 1 - ctx.padding), None


def _blurred(planes: Tensor, padding: int) -> Tensor:
    taps, cudnn = _taps(planes.device, planes.dtype), torch.backends.cudnn
    # TF32, which torch allows convolutions, would round pixels to 11 bits, and leave nothing of E[x^2] - E[x]^2.
    with cudnn.flags(cudnn.enabled, cudnn.benchmark, deterministic=cudnn.deterministic, allow_tf32=False):
        rows = F.conv2d(planes, taps[None, None, None], padding=(0, padding))
        return F.conv2d(rows, taps[None, None, :, None], padding=(padding, 0))


@overload
def psnr_from_mse(mean_square: float) -> float: ...
@overload
def psnr_from_mse(mean_square: Float[Tensor, ""]) -> Float[Tensor, ""]: ...
def psnr_from_mse(mean_square: float | Tensor) -> float | Tensor:
    """Return `-10 log10(mean square error)` of images in [0, 1], in dB.

    Errors below 1e-12 count as 1e-12, so that equal images have 120 dB and means over images stay finite. Of a scalar
    tensor, a tensor on its device.
    """
    least = 1e-12
    if isinstance(mean_square, Tensor):
        return -10.0 * torch.log10(mean_square.clamp(min=least))
    return -10.0 * math.log10(max(mean_square, least))


class _SsimMean(torch.autograd.Function):
    """Mean SSIM; the kernel returns value and gradient in one sweep, so the backward pass only scales."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, mask: Tensor | None, border: int, differentiate: bool) -> Tensor:
        B, H, W, C = x.shape
        # The kernel scales each pixel's term by 1 / (C times the sum of weights), so that its sum is the mean
        # already.
        weight: float
        if mask is None:
            weight = B * (H - 2 * border) * (W - 2 * border)
        else:
            weight = _total_weight(_inner(mask, border), x.shape).item()
        want_x, want_y = (differentiate and wanted for wanted in ctx.needs_input_grad[:2])
        value, _, grad_x, grad_y = _call(x, y, mask, border, scale=1.0 / (weight * C), grad_x=want_x, grad_y=want_y)
        ctx.save_for_backward(grad_x, grad_y)
        return torch.tensor(value, dtype=x.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        grad_x, grad_y = ctx.saved_tensors
        return None if grad_x is None else grad_x * grad, None if grad_y is None else grad_y * grad, None, None, None


class _SsimMap(torch.autograd.Function):
    """SSIM map; its backward pass runs the kernel again, weighted by the incoming gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, border: int) -> Tensor:
        ctx.save_for_backward(x, y)
        ctx.border = border
        values = _call(x, y, None, border, map_=True)[1]
        assert values is not None  # asked for
        return _inner(values, border)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, y = ctx.saved_tensors
        b = ctx.border
        # The chain rule weights each pixel's SSIM by the incoming gradient; pixels outside of a "valid" map have
        # weight 0.
        weight = F.pad(grad, (0, 0, b, b, b, b)).contiguous()
        want_x, want_y = ctx.needs_input_grad[:2]
        _, _, grad_x, grad_y = _call(x, y, weight, b, grad_x=want_x, grad_y=want_y)
        return grad_x, grad_y, None


def _call(
    x: Tensor,
    y: Tensor,
    weight: Tensor | None,
    border: int,
    *,
    scale: float = 1.0,
    map_: bool = False,
    grad_x: bool = False,
    grad_y: bool = False,
) -> tuple[float, Tensor | None, Tensor | None, Tensor | None]:
    """Run the kernel: sum of scale * weight * SSIM, the map (B, H, W, C), the gradient of the sum by each image.

    `weight` is (H, W), (B, H, W) or (B, H, W, C).
    """
    # The kernel gives the gradient of its first image; SSIM is symmetric, so swap them if only the second needs one.
    if grad_y and not grad_x:
        swapped, values, by_y, _ = _call(y, x, weight, border, scale=scale, map_=map_, grad_x=True)
        return swapped, values, None, by_y
    B, H, W, C = x.shape
    check_size(W, H, "images of SSIM")
    values, by_x, by_y = (pooled_empty(*x.shape) if wanted else None for wanted in (map_, grad_x, grad_y))
    value = ctypes.c_double()
    native_library().smplxpp_ssim(
        address(x),
        address(y),
        address(weight),
        C if weight is not None and weight.dim() == 4 else 1,
        int(weight is not None and weight.dim() > 2),
        ctypes.c_float(scale),
        B,
        H,
        W,
        C,
        border,
        ctypes.byref(value),
        address(values),
        address(by_x),
        address(by_y),
        thread_count(torch.get_num_threads()),
    )
    return value.value, values, by_x, by_y


def _native(x: Tensor) -> bool:
    return x.device.type == "cpu" and x.dtype == torch.float32


def _inner(value: Tensor, border: int) -> Tensor:
    """Crop a border off the image axes: those before the channels of a map (B, H, W, C), or the last two of a mask."""
    if not border:
        return value
    inside = slice(border, -border)
    return value[..., inside, inside, :] if value.dim() == 4 else value[..., inside, inside]


def _checked(x: Tensor, y: Tensor, mask: Tensor | None, padding: str) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return contiguous images with a batch axis, and the mask in their type."""
    if padding not in _BORDER:
        raise InputError("padding of SSIM", expected="'zero' or 'valid'", received=repr(padding))
    _check_images(x, y, mask, least=1 if padding == "zero" else WINDOW)
    if mask is not None:
        mask = mask.detach().to(x.dtype).contiguous()
    x, y = (v.contiguous() if v.dim() == 4 else v.contiguous()[None] for v in (x, y))
    return x, y, mask


def _check_images(x: Tensor, y: Tensor, mask: Tensor | None = None, *, least: int = 1) -> None:
    """Check the inputs of an image loss: two float images (H, W, C) or (B, H, W, C) of one shape and type, and a mask.

    Raises:
        InputError: anything else; images under `least` pixels a side; a mask that is neither (H, W) nor one an image.
    """
    # Shape of the first image, agreement of the second, then device and shape of the mask.
    if x.dim() not in (3, 4) or 0 in x.shape or min(x.shape[-3:-1]) < least:
        raise InputError(
            "image",
            expected=f"(H, W, C) or (B, H, W, C) of at least {least} x {least} pixels and one channel",
            received=f"shape {tuple(x.shape)}",
        )
    if y.shape != x.shape or y.dtype != x.dtype or not x.is_floating_point():
        raise InputError(
            "images to compare",
            expected="two floating-point images of one shape and type",
            received=f"{tuple(x.shape)} {x.dtype} and {tuple(y.shape)} {y.dtype}",
            remedy="divide 8-bit images by 255",
        )
    for name, other in (("second image", y), ("mask", mask)):
        if other is not None and other.device != x.device:
            raise InputError(name, expected=f"device {x.device}, as the image", received=str(other.device))
    if mask is not None and mask.shape not in (x.shape[-3:-1], x.shape[:-1]):
        raise InputError(
            "mask of an image loss",
            expected=f"shape {tuple(x.shape[-3:-1])}" + (f" or {tuple(x.shape[:-1])}" if x.dim() == 4 else ""),
            received=str(tuple(mask.shape)),
        )


def _total_weight(mask: Shaped[Tensor, "... H W"], shape: tuple[int, ...]) -> Shaped[Tensor, ""]:
    """Return the sum of a mask's weights over images (..., H, W, C) of `shape`, without the channels.

    Raises:
        InputError: the sum is not positive.
    """
    # A mask (H, W) over a batch counts once for each image.
    total = mask.sum() * (shape[0] if len(shape) > mask.dim() + 1 else 1)
    if not total > 0:
        raise InputError("mask of an image loss", expected="some weight above 0", received=f"a sum of {float(total)}")
    return total


def _mean_of_map(value: Tensor, x: Tensor, y: Tensor, mask: Tensor | None, padding: str) -> Tensor:
    """Return the mean of a map of two images, weighted by a mask of them."""
    _check_images(x, y, mask)
    return _masked_mean(value, None if mask is None else _inner(mask, _BORDER[padding]))


def _masked_mean(
    value: Float[Tensor, "*B H W C"], mask: Shaped[Tensor, "*B H W"] | Shaped[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Return the mean, or `sum(mask value) / (C sum(mask))` with a mask, one for each image or for all."""
    if mask is None:
        return value.mean()
    weight = mask.to(value.dtype)
    return (weight[..., None] * value).sum() / (_total_weight(weight, value.shape) * value.shape[-1])
