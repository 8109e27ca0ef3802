"""Penalties that keep Gaussians small and near their triangles (GaussianAvatars, Qian et al. 2024)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.frames import TriangleFrames
from avatar.gaussians.gather import gather_rows

MAX_SCALE = 0.6
"""Mean edge lengths; larger standard deviations are penalised."""
MAX_OFFSET = 1.0
"""Mean edge lengths; Gaussians farther from their place on the triangle are penalised."""
OFFSET_WEIGHT = 0.01
"""Weight of the offsets' penalty against that of the scales."""


def scale_penalty(bound: BoundGaussians) -> Float[Tensor, ""]:
    """Return the mean over the Gaussians of `|relu(s - 0.6)|`, s the tangential scales in mean edge lengths."""
    return torch.relu(torch.exp(bound.log_scales) - MAX_SCALE).norm(dim=-1).mean()


def offset_penalty(bound: BoundGaussians, frames: TriangleFrames) -> Float[Tensor, ""]:
    """Return 0.01 times the mean of `relu(|du + gamma [1, 0, 0]| / e - 1)`; offsets are metres, the bound an edge."""
    total = torch.cat([bound.offset[:, :1] + bound.normal_offset[:, None], bound.offset[:, 1:]], 1)
    lengths = gather_rows(frames.lengths, bound.face_index)
    return OFFSET_WEIGHT * torch.relu(total.norm(dim=-1) / lengths - MAX_OFFSET).mean()
