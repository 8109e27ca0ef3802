"""Volume rendering of a signed distance without bias towards the front (Wang et al. 2021, NeuS)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def opacities(distance: Float[Tensor, "R S"], sharpness: Float[Tensor, ""]) -> Float[Tensor, "R T"]:
    """Opacity of each interval between samples: how much of the logistic of the distance falls across it."""
    at = torch.sigmoid(distance * sharpness)
    return ((at[:, :-1] - at[:, 1:]) / at[:, :-1].clamp(min=1e-6)).clamp(0, 1)


def weights_of(opacity: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """How much each interval adds to the pixel: its opacity times what those before it let through."""
    through = torch.cumprod(1 - opacity + 1e-7, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    return opacity * before
