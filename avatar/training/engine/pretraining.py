"""Pretraining without rendering: networks learn known displacements, many poses a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avatar.training.engine.optimization_task import OptimiserConfig, OptimizationTask, ParameterGroup
from smplxpp.core.errors import require_at_least

CACHE_BYTES = 1 << 30
"""Bound of the cache of inputs and known displacements, bytes: 1 GiB."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """Choices of a pretraining: batch, steps and learning rate.

    Attributes:
        iterations: steps of Adam.
        batch: poses a step.
        lr: learning rate at the start.
        lr_final_factor: share of it left at the end.
        warmup: steps over which it rises linearly, see `OptimiserConfig`.
        betas: of Adam.
    """

    iterations: int
    batch: int = 1
    lr: float = 5e-4
    lr_final_factor: float = 0.05
    warmup: int = 0
    betas: tuple[float, float] = (0.9, 0.999)

    def __post_init__(self) -> None:
        for name, least in (("iterations", 1), ("batch", 1), ("warmup", 0)):
            require_at_least(f"pretraining: {name}", getattr(self, name), least)

    @property
    def evaluate_every(self) -> int:
        """Steps between evaluations; there are none before the end."""
        return self.iterations

    def optimiser(self) -> OptimiserConfig:
        """Return the configuration of Adam for these steps."""
        return OptimiserConfig(iterations=self.iterations, warmup=self.warmup, betas=self.betas)

    def shortened(self, share: float) -> PretrainConfig:
        """Return the configuration with `share` of the steps."""
        return replace(self, iterations=max(1, round(share * self.iterations)))


class PretrainTask(OptimizationTask[tuple[int, ...]]):
    """A pretraining with one batch a step, in a new random order each epoch."""

    def __init__(self, groups: Sequence[ParameterGroup], config: PretrainConfig, count: int, seed: int) -> None:
        super().__init__(groups, config.optimiser())
        self.batch, self.count, self.seed = min(config.batch, count), count, seed

    def micro_batches(self, iteration: int) -> Sequence[tuple[int, ...]]:
        """Return the numbers of a step's poses, each at most once an epoch; a remainder waits for the next one."""
        # The permutation follows from seed and epoch alone, so that a resumed training draws the same batches.
        per_epoch = self.count // self.batch
        epoch, place = divmod(iteration, per_epoch)
        order = np.random.default_rng((self.seed, 3, epoch)).permutation(self.count)
        return [tuple(order[place * self.batch : (place + 1) * self.batch].tolist())]

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return no figures, because no view is rendered."""
        return {"mean": {}}
