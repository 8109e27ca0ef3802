"""Weight of a pose by its distance from the training poses, near which pose-driven shapes are valid."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class PoseGate(nn.Module):
    """`g(theta) = exp(-((d - d_0) / d_0)^2 / 2)` for d > d_0, else 1, with d the distance to the nearest known pose.

    d_0 is the median distance of a known pose to its nearest other one, so that poses between two consecutive frames
    have weight 1.

    Args:
        poses: theta of the training frames, radians.
    """

    poses: Tensor
    scale: Tensor

    def __init__(self, poses: Float[Tensor, "T 63"]) -> None:
        super().__init__()
        self.register_buffer("poses", poses.detach().clone())
        apart = torch.cdist(poses.double(), poses.double())
        apart.fill_diagonal_(float("inf"))
        nearest = apart.min(dim=1).values
        near = nearest[nearest.isfinite()]
        least_scale = 0.035  # radians, two degrees of one joint, for a single pose or copies of one
        scale = max(float(near.median()) if len(near) else 0.0, least_scale)
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))

    def forward(self, pose: Float[Tensor, " 63"]) -> Float[Tensor, ""]:
        """Return the weight g of a pose, in [0, 1]."""
        distance = (self.poses - pose).norm(dim=1).min()
        over = ((distance - self.scale) / self.scale).clamp(min=0.0)
        return torch.exp(-0.5 * over.square())
