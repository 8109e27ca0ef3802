"""What Gaussians look like, learned from all views of all frames at once: their colours, and how deep they lie."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians
from avatar.training.refinement.evidence import Evidence

SEEN = 1e-6
"""Share of the mean mass of a colour from which its Gaussian counts as seen."""
DEPTH_SIGMA, DEEPEST, HIGHEST = 0.003, -0.012, 0.002
"""Metres that depths are trusted to beforehand, and their bounds along the normal."""


class AppearanceSums:
    """What moves the appearance, summed over frames.

    Colours: `c <- c - sum g / sum m`, g the gradient of a colour and m the mass of pixels that it has a part in: the
    simultaneous iterative reconstruction of Gilbert (1972), which needs no rate and cannot overshoot, as the parts of a
    pixel's Gaussians sum to at most 1.

    Depths: Gaussians that overlap draw the person too fat, the more the coarser they and the pixels are, and a body
    whose feet a skirt hides would sink to mend its head. One shift along the normals for each group takes that away: a
    Gauss-Newton step of one number, `sum f n.g / sum f n^T M n` with the firmness f.

    Args:
        groups: of the Gaussians, from 0. firmness: of the Gaussians.
    """

    def __init__(self, groups: Int64[Tensor, " N"], firmness: Float32[Tensor, " N"]) -> None:
        N, G = len(groups), int(groups.max()) + 1 if len(groups) else 0
        self.groups, self.firmness = groups, firmness
        self.gradient, self.mass = torch.zeros(N, 3), torch.zeros(N)
        self._pull, self._stiffness = torch.zeros(G, dtype=torch.float64), torch.zeros(G, dtype=torch.float64)

    def add(self, evidence: Evidence) -> None:
        """Take the views of a frame in."""
        self.gradient += evidence.color_gradient
        self.mass += evidence.color_mass
        normals, firm = evidence.normals, self.firmness
        pull = firm * (normals * evidence.pull).sum(-1)
        stiffness = firm * (normals * (evidence.curvature @ normals[..., None])[..., 0]).sum(-1)
        self._pull.index_add_(0, self.groups, pull.double())
        self._stiffness.index_add_(0, self.groups, stiffness.double())

    def learned(self, gaussians: BoundGaussians, frames: int) -> BoundGaussians:
        """Return the Gaussians with colours and depths that fit better; those that nobody saw stay.

        Args:
            frames: number of those that were taken in, for the trust in depths.
        """
        seen = self.mass > SEEN * self.mass.mean()
        step = torch.where(seen[:, None], self.gradient / torch.where(seen, self.mass, 1.0)[:, None], 0.0)
        trust = frames / DEPTH_SIGMA**2
        depth = torch.zeros_like(self._pull).index_copy_(0, self.groups, gaussians.normal_offset.double())
        depth = (depth - (self._pull + trust * depth) / (self._stiffness + trust)).clamp(DEEPEST, HIGHEST)
        return replace(gaussians, dc=(gaussians.dc - step).clamp(0.0, 1.0), normal_offset=depth[self.groups].float())
