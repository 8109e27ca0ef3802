"""Mean of the parameters over the last steps of a training (Polyak and Juditsky 1992; Izmailov et al. 2018)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from avatar.gaussians.tensor_file import require_finite, require_like

EVERY = 10
"""Steps between two that enter the mean: neighbours differ little, and a mean of every step would cost time."""
_PREFIX = "mean."


class MeanOfSteps:
    """Running mean of parameters over the last `share` of the steps; it replaces them after the last one.

    Adam's steps have the same length however small a gradient is. Weakly observed parameters therefore wander until the
    rates are small, and end at a random point. Their mean is near the centre.

    Args:
        learned: parameters by key, which steps change in place.
        iterations: T, number of all steps.
        share: in [0, 1]; 0: no mean.
    """

    def __init__(self, learned: Mapping[str, Tensor], iterations: int, share: float) -> None:
        self.learned, self.last = learned, iterations - 1
        self.first = iterations - round(share * iterations)
        self.mean: dict[str, Tensor] = {}

    @torch.no_grad()
    def after(self, iteration: int) -> None:
        """Update the mean after a step, counted from 0; after the last one copy it into the parameters."""
        # Running mean of every n-th step: m <- m + (x - m) / k.
        since = iteration - self.first
        if since >= 0 and since % EVERY == 0:
            if not since:
                self.mean = {key: value.detach().clone() for key, value in self.learned.items()}
            for key, mean in self.mean.items():
                # m + (x - m) / k, which needs no sum of k terms and no number of steps in advance.
                mean.lerp_(self.learned[key], 1.0 / (since // EVERY + 1))
        if iteration == self.last:
            for key, mean in self.mean.items():
                self.learned[key].copy_(mean)

    def state(self) -> dict[str, Tensor]:
        """Return the current mean by key; empty before the first step that enters it."""
        return {_PREFIX + key: mean for key, mean in self.mean.items()}

    def restore(self, tensors: Mapping[str, Tensor], *, remedy: str) -> None:
        """Continue from a `state`, among other tensors.

        Raises:
            InputError: tensors that are missing, of another shape or type, or not finite; nothing has changed.
        """
        if not any(key.startswith(_PREFIX) for key in tensors):
            self.mean = {}
            return
        # Check all tensors before any is taken.
        wanted = {_PREFIX + key: value for key, value in self.learned.items()}
        require_like(tensors, wanted, subject="checkpoint", remedy=remedy)
        require_finite({key: tensors[key] for key in wanted}, subject="checkpoint", remedy=remedy)
        self.mean = {key: torch.empty_like(value).copy_(tensors[_PREFIX + key]) for key, value in self.learned.items()}
