"""Photometric losses and metrics of images in [0, 1], channels last.

Every function takes (H, W, C) or (B, H, W, C) images and a mask of weights (H, W) or (B, H, W), with which a mean
becomes `sum(mask value) / (C sum(mask))`. Composite on one background before comparing: a mask weighs pixels, it does
not remove what lies behind them. A batch is one big image: for the mean of each image's PSNR, call it for each.
"""

from __future__ import annotations

import torch
from torch import Tensor

from avatar.losses.checks import check_images, mean
from avatar.losses.ssim import ssim


def l1(x: Tensor, y: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Mean absolute difference: scalar.

    Raises:
        InputError: images or a mask that do not fit each other.
    """
    check_images(x, y, mask)
    return mean((x - y).abs(), mask)


def d_ssim(x: Tensor, y: Tensor, *, mask: Tensor | None = None, padding: str = "zero") -> Tensor:
    """`1 - SSIM`, not halved, as in the code of 3D Gaussian Splatting: scalar, 0 for equal images. See `ssim`."""
    return 1.0 - ssim(x, y, mask=mask, padding=padding)


def psnr(x: Tensor, y: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio for a peak of 1, `-10 log10(mean squared error)`: scalar in dB, inf for equal images.

    Raises:
        InputError: images or a mask that do not fit each other.
    """
    check_images(x, y, mask)
    return -10.0 * torch.log10(mean((x - y) ** 2, mask))
