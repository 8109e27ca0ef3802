"""How close a rendered view comes to its photograph, by conventions that are named."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from avatar.losses.ssim import ssim
from avatar.training.views import View

OPACITY_THRESHOLD = 0.02
CONVENTION = (
    "PSNR: over pixels where mask or rendered opacity exceed 0.02. Image: over all pixels, on the plain background. "
    "SSIM: 11x11 Gaussian window, sigma 1.5, zero padding, mean over all pixels. "
    "Head: PSNR of the first kind within the head's box."
)
Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class ViewQuality:
    """Figures of one view.

    Attributes:
        psnr: dB over the person: the union of the silhouettes, mask or rendered opacity above 0.02.
        psnr_image: dB over the whole composited image.
        ssim: mean over the whole composited image.
        psnr_head: as `psnr`, within the box of the head; None where the head is not in the image.
    """

    psnr: float
    psnr_image: float
    ssim: float
    psnr_head: float | None = None


def decibels(mean_square: float) -> float:
    """Peak signal-to-noise ratio of images in [0, 1]: `-10 log10(mean square error)`; infinite for equal images."""
    return -10.0 * math.log10(mean_square) if mean_square > 0 else math.inf


def view_quality(view: View, image: Tensor, alpha: Tensor, background: Tensor, *, head: Box | None) -> ViewQuality:
    """Compare a rendered image with the view's.

    Args:
        image: (H, W, 3), clamped to [0, 1] as a screen would. alpha: (H, W) rendered opacity.
        background: (3,) that both are on.
        head: x0, y0, x1, y1 in pixels.
    """
    real = view.composited(background)
    image = image.clamp(0.0, 1.0)
    error = (image - real).square()
    person = (view.opacity() > OPACITY_THRESHOLD) | (alpha > OPACITY_THRESHOLD)
    psnr_head = None
    if head is not None:
        part = (slice(head[1], head[3]), slice(head[0], head[2]))
        if bool(person[part].any()):
            psnr_head = decibels(float(error[part][person[part]].mean()))
    return ViewQuality(
        psnr=decibels(float(error[person].mean())),
        psnr_image=decibels(float(error.mean())),
        ssim=float(ssim(image, real)),
        psnr_head=psnr_head,
    )


def mean_quality(views: Mapping[str, ViewQuality]) -> dict[str, float]:
    """Plain means over views of each figure that every view has."""
    columns = {f.name: [getattr(quality, f.name) for quality in views.values()] for f in fields(ViewQuality)}
    return {name: sum(values) / len(values) for name, values in columns.items() if values and None not in values}


def eight_bit(image: Tensor) -> Tensor:
    """(H, W, 3) in [0, 1] as uint8 on the CPU."""
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu()
