"""Trainings without rendering: networks that learn known displacements, many poses a step, at little cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avatar.training.engine.optimization_task import OptimiserConfig, OptimizationTask, ParameterGroup
from smplxpp.core.validation import require_at_least

KNOWN_BYTES = 1 << 30
"""Of inputs and known displacements that are kept."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """Choices of a training without rendering.

    Attributes:
        iterations: steps of Adam. batch: poses a step.
        lr, lr_final_factor, warmup, betas: of Adam, see `OptimiserConfig`.
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
        """Steps between evaluations: nothing is measured on the way."""
        return self.iterations

    def optimiser(self) -> OptimiserConfig:
        """Return the optimiser of these steps."""
        return OptimiserConfig(iterations=self.iterations, warmup=self.warmup, betas=self.betas)

    def shortened(self, share: float) -> PretrainConfig:
        """Return the same with `share` of the steps."""
        return replace(self, iterations=max(1, round(share * self.iterations)))


class PretrainTask(OptimizationTask[tuple[int, ...]]):
    """A training that takes one batch a step, in an order that changes from epoch to epoch."""

    def __init__(self, groups: Sequence[ParameterGroup], config: PretrainConfig, count: int, seed: int) -> None:
        super().__init__(groups, config.optimiser())
        self.batch, self.count, self.seed = min(config.batch, count), count, seed

    def micro_batches(self, iteration: int) -> Sequence[tuple[int, ...]]:
        """Return the numbers of a step's poses: each at most once an epoch, what batches leave over in another one."""
        per_epoch = self.count // self.batch
        epoch, place = divmod(iteration, per_epoch)
        order = np.random.default_rng((self.seed, 3, epoch)).permutation(self.count)
        return [tuple(order[place * self.batch : (place + 1) * self.batch].tolist())]

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return nothing: no view is rendered."""
        return {"mean": {}}
