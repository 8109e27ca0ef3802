"""What every image loss asks of its input."""

from __future__ import annotations

from jaxtyping import Float, Shaped
from torch import Tensor

from smplxpp.core.errors import InputError


def check_images(x: Tensor, y: Tensor, mask: Tensor | None = None, *, least: int = 1) -> None:
    """Require two float images (H, W, C) or (B, H, W, C) of one shape, type and device, and weights for their pixels.

    Raises:
        InputError: anything else; images under `least` pixels a side; a mask that is neither (H, W) nor one an image.
    """
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


def total_weight(mask: Shaped[Tensor, "... H W"], shape: tuple[int, ...]) -> Shaped[Tensor, ""]:
    """Return the sum of the weights that a mask gives to images (..., H, W, C) of `shape`, channels not counted.

    Raises:
        InputError: there is none.
    """
    total = mask.sum() * (shape[0] if len(shape) > mask.dim() + 1 else 1)
    if not total > 0:
        raise InputError("mask of an image loss", expected="some weight above 0", received=f"a sum of {float(total)}")
    return total


def mean(
    value: Float[Tensor, "*B H W C"], mask: Shaped[Tensor, "*B H W"] | Shaped[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Return the mean, or `sum(mask value) / (C sum(mask))` with a mask, one for each image or for all."""
    if mask is None:
        return value.mean()
    weight = mask.to(value.dtype)
    return (weight[..., None] * value).sum() / (total_weight(weight, value.shape) * value.shape[-1])
