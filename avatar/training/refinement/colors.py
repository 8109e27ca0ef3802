"""Colours of Gaussians learned from all views of all frames at once."""

from __future__ import annotations

from dataclasses import replace

import torch

from avatar.gaussians.binding import BoundGaussians
from avatar.training.refinement.evidence import Evidence

SEEN = 1e-6
"""Share of the mean mass of a colour from which its Gaussian counts as seen."""


class ColorSums:
    """What moves the colours, summed over frames: `c <- c - sum g / sum m`.

    g is the gradient of a colour and m the mass of pixels that it has a part in: the simultaneous iterative
    reconstruction of Gilbert (1972), which needs no rate and cannot overshoot, as the parts of a pixel's Gaussians sum
    to at most 1.

    Args:
        count: of Gaussians.
    """

    def __init__(self, count: int) -> None:
        self.gradient, self.mass = torch.zeros(count, 3), torch.zeros(count)

    def add(self, evidence: Evidence) -> None:
        """Take the views of a frame in."""
        self.gradient += evidence.color_gradient
        self.mass += evidence.color_mass

    def learned(self, gaussians: BoundGaussians) -> BoundGaussians:
        """Return the Gaussians with colours that fit better; those that nobody saw stay."""
        seen = self.mass > SEEN * self.mass.mean()
        step = torch.where(seen[:, None], self.gradient / torch.where(seen, self.mass, 1.0)[:, None], 0.0)
        return replace(gaussians, dc=(gaussians.dc - step).clamp(0.0, 1.0))
