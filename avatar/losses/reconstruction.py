"""Compute the loss between a rendered view and its photograph, shared by teacher, bake and compensation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.losses.image_similarity import psnr_from_mse, ssim
from avatar.losses.perceptual import MIN_SIZE, PerceptualDistance
from smplxpp.core.errors import one_line, require_at_least

if TYPE_CHECKING:
    from avatar.rendering.avatar_view import Rendering


@dataclass(frozen=True, kw_only=True)
class ReconstructionWeights:
    """Weights of `L_rec = w L1 + a D-SSIM + b LPIPS + c L_nor + d L_alpha + e L2`. The defaults are the paper's.

    Attributes:
        l1: weight of the mean absolute difference of colours.
        dssim: weight of `1 - SSIM`.
        perceptual: weight of LPIPS or ST-LPIPS.
        normal: weight of the L1 between normals.
        alpha: weight of the L1 between opacity and mask. The paper does not have it; without it, dark hair before a
            black background may become transparent.
        l2: weight of the mean squared difference of colours, which emphasises large errors. The paper does not have it.
    """

    l1: float = 1.0
    dssim: float = 0.2
    perceptual: float = 0.01
    normal: float = 0.02
    alpha: float = 0.0
    l2: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            require_at_least(f"loss weight {f.name}", getattr(self, f.name), 0)


@dataclass(frozen=True, eq=False)
class Target:
    """The target that a rendering is compared with.

    Attributes:
        image: sRGB on the background.
        alpha: opacity of the person.
        normals: in world axes, 0 on the background; None without normals.
    """

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    normals: Float[Tensor, "H W 3"] | None = None

    __repr__ = one_line


def reconstruction_loss(
    rendering: Rendering,
    target: Target,
    weights: ReconstructionWeights,
    *,
    perceptual: PerceptualDistance | None = None,
) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
    """Return the weighted sum of the losses, and its terms as scalars without gradients on the same device.

    D-SSIM is `1 - SSIM`, as in the code of 3DGS. `L_nor = mean |N_t - N_g|_1` over the pixels where the target has a
    normal. Terms without their inputs (normals, a perceptual distance, an image of its minimum size) are left out.
    """
    # Each term is added in this order, because the order of a sum decides its last bits.
    difference = rendering.image - target.image
    l1 = difference.abs().mean()
    total, terms = weights.l1 * l1, {"l1": l1}
    if weights.l2:
        terms["l2"] = difference.square().mean()
        total = total + weights.l2 * terms["l2"]
    if weights.dssim:
        terms["dssim"] = 1.0 - ssim(rendering.image, target.image)
        total = total + weights.dssim * terms["dssim"]
    if weights.alpha:
        terms["alpha"] = (rendering.alpha - target.alpha).abs().mean()
        total = total + weights.alpha * terms["alpha"]
    if weights.perceptual and perceptual is not None and min(target.alpha.shape) >= MIN_SIZE:
        # The networks were trained on images in [0, 1]; colours of spherical harmonics may exceed 1.
        image = rendering.image.clamp(0.0, 1.0)
        terms["perceptual"] = perceptual(image[None], target.image[None])[0]
        total = total + weights.perceptual * terms["perceptual"]
    if weights.normal and rendering.normals is not None and target.normals is not None:
        # A zero vector marks a pixel without a normal; the L1 norm is taken over x, y, z.
        known = (target.normals != 0).any(-1).flatten().nonzero().squeeze(1)
        if len(known):
            apart = (rendering.normals - target.normals.float()).abs().sum(-1)
            terms["normal"] = apart.flatten()[known].mean()
            total = total + weights.normal * terms["normal"]
    # PSNR of the crop for the log alone, on clamped colours as a display shows them.
    with torch.no_grad():
        square = (rendering.image.clamp(0.0, 1.0) - target.image).square().mean()
        psnr = psnr_from_mse(square)
    return total, {**{name: term.detach() for name, term in terms.items()}, "psnr_crop": psnr}
