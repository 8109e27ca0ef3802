"""Bases of all trainings: Adam on micro-batches, a stop at the first NaN, exact resumption; pretrainings."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from avatar.gaussians.tensor_file import require_finite, require_like
from avatar.training.engine.adam import MOMENTS, Adam, MeanOfSteps, OptimiserConfig, ParameterGroup
from avatar.training.engine.processes import Distributed
from smplxpp.core import InputError, require_at_least

CACHE_BYTES = 1 << 30
"""Bound of the cache of inputs and known displacements, bytes: 1 GiB."""
Batch = TypeVar("Batch")
_START_AGAIN = "delete the file of its state, or give --force, to start again"


class DivergedError(InputError):
    """A loss or gradient is not finite. Parameters and the last checkpoint are as before the step."""


class OptimizationTask(ABC, Generic[Batch]):
    """A task of `run_training` that Adam solves: the mean loss of a step's micro-batches goes down.

    A subclass says what the micro-batches of a step are (`micro_batches`) and what each costs (`loss`). Micro-batches
    of one process are taken one after the other and their gradients added up, so that a step needs the memory of one;
    several processes share them out.

    Args:
        groups: what is learned.
        config: how.
        distributed: the processes that train together; this one alone by default.
    """

    def __init__(
        self, groups: Sequence[ParameterGroup], config: OptimiserConfig, distributed: Distributed | None = None
    ) -> None:
        self.groups, self.optimiser_config = tuple(groups), config
        self.distributed = distributed or Distributed()
        # Keys of the checkpoint. Two tensors with one key would overwrite each other there.
        keyed = [(f"{group.name}.{name}", value) for group in groups for name, value in group.parameters.items()]
        self.learned = dict(keyed)
        assert len(self.learned) == len(keyed) > 0, "parameters need keys of their own"
        self.device = keyed[0][1].device
        learned = [{"params": list(group.parameters.values()), "lr": group.lr} for group in groups]
        self.optimiser = Adam(learned, betas=config.betas, eps=config.eps)
        self.mean = MeanOfSteps(self.learned, config.iterations, config.averaged)
        self._rate_share = 1.0

    @abstractmethod
    def micro_batches(self, iteration: int) -> Sequence[Batch]:
        """Return the micro-batches of a step: one or more, decided by its number alone, the same on every process."""

    @abstractmethod
    def loss(self, item: Batch) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the loss of a micro-batch, a scalar with gradients, and its terms for the log, scalars without.

        Terms stay on the device, because each transfer of a number would wait for the GPU; `run_training` transfers
        those of the steps that it logs.
        """

    def lr_factor(self, iteration: int, group: ParameterGroup) -> float:
        """Return the share of a group's rate that is left at a step: the configuration's schedule."""
        return self.optimiser_config.lr_factor(iteration, group.lr_final_factor)

    def name_of(self, item: Batch) -> str:
        """Return a micro-batch in the user's words: "frame 12, cameras Cam001 Cam002"."""
        return str(item)

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return figures of the state after `iteration` steps; none by default."""
        return {}

    def autocast(self) -> torch.autocast:
        """Return the autocast context of networks alone; rasteriser and losses need their outputs in float32."""
        enabled = self.optimiser_config.amp and self.device.type == "cuda"
        # Every weight is used once a pass, so that a cache of rounded ones would gain nothing; graphs cannot have it.
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled, cache_enabled=False)

    def step(self, iteration: int) -> Mapping[str, Any]:
        """Take one step of Adam on the mean over the micro-batches.

        Returns:
            Means of the losses' terms, each over the items that gave it, and the items' names.

        Raises:
            DivergedError: a loss or gradient is not finite, on any process; nothing has changed.
            InputError: fewer items than processes.
        """
        # Rates of this step by the schedule; fused Adam reads them from its groups.
        items = self.micro_batches(iteration)
        for group, own in zip(self.optimiser.param_groups, self.groups, strict=True):
            group["lr"] = own.lr * self.lr_factor(iteration, own) * self._rate_share
        # Gradients of the micro-batches, shared among the processes and summed over them.
        self.optimiser.zero_grad()
        outcomes = self.distributed.share_out(items, lambda item: self._backward(item, len(items)))
        # A loss that is not finite on any process stops all of them, before a parameter has changed.
        finite = []
        for item, figures in zip(items, outcomes, strict=True):
            if figures is None:
                raise _diverged(iteration, self.name_of(item))
            finite.append(figures)
        parameters = list(self.learned.values())
        self.distributed.sum_gradients(parameters)
        # Adam's step, and the mean of the last steps.
        if self.optimiser_config.max_grad_norm < math.inf:
            torch.nn.utils.clip_grad_norm_(parameters, self.optimiser_config.max_grad_norm)
        self.optimiser.step()
        self.mean.after(iteration)
        return {**_means(finite), "items": [self.name_of(item) for item in items]}

    def state(self) -> Mapping[str, Tensor]:
        """Return parameters by `group.name`, Adam's moments of each that has taken a step, and the current mean."""
        tensors = {**self.learned, **self.mean.state()}
        for key, value in self.learned.items():
            for moment, content in self.optimiser.state.get(value, {}).items():
                tensors[f"adam.{moment}.{key}"] = content
        return tensors

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from a `state`, bit for bit.

        Raises:
            InputError: tensors that are missing, of another shape or type, or not finite; nothing has changed.
        """
        # Check all tensors before any is copied.
        wanted = dict(self.learned)
        for key, value in self.learned.items():
            if any(f"adam.{moment}.{key}" in tensors for moment in MOMENTS):
                shapes = {"step": torch.empty(()), "exp_avg": value, "exp_avg_sq": value}
                wanted |= {f"adam.{moment}.{key}": shapes[moment] for moment in MOMENTS}
        require_like(tensors, wanted, subject="checkpoint", remedy=_START_AGAIN)
        require_finite({name: tensors[name] for name in wanted}, subject="checkpoint", remedy=_START_AGAIN)
        self.mean.restore(tensors, remedy=_START_AGAIN)
        with torch.no_grad():
            # Parameters, and Adam's moments in the parameters' memory layout.
            for key, value in self.learned.items():
                value.copy_(tensors[key])
                moments = {moment: tensors.get(f"adam.{moment}.{key}") for moment in MOMENTS}
                self.optimiser.state[value] = {
                    moment: _copy_in_layout(content, value)
                    for moment, content in moments.items()
                    if content is not None
                }

    def halve_rates(self) -> None:
        """Halve all learning rates from now on."""
        self._rate_share *= 0.5

    def leave_out(self, iteration: int) -> None:
        """Count a step that diverged as taken: it may be the one that begins or ends the mean of the last steps."""
        self.mean.after(iteration)

    def _backward(self, item: Batch, count: int) -> Mapping[str, Tensor] | None:
        """Backpropagate a micro-batch's share of the loss; return its terms, None if anything is not finite."""
        # Divided by the number of micro-batches, so that the sum of all gradients is that of the mean loss.
        loss, figures = self.loss(item)
        (loss / count).backward()
        gradients = (value.grad for value in self.learned.values() if value.grad is not None)
        if not _finite((loss, *gradients)):
            return None
        return figures


def _copy_in_layout(content: Tensor, parameter: Tensor) -> Tensor:
    """Return a copy with the parameter's device and memory layout, because fused Adam walks both together."""
    if content.shape != parameter.shape:  # the number of steps
        return content.to(parameter.device, copy=True)
    return torch.empty_like(parameter).copy_(content)


@torch.no_grad()
def _finite(values: Iterable[Tensor]) -> bool:
    """Return whether all values are finite: a sum or a largest magnitude is NaN or infinite when any value is."""
    values = list(values)
    if values[0].device.type == "cpu":
        # The largest magnitude takes ten times as long there, an eighth of a step of the compensation.
        figures = [value.sum() for value in values]
    else:
        # One call for all tensors, which is a few launches on a GPU, and one transfer of the answer.
        figures = list(torch._foreach_norm(values, ord=torch.inf))
    return bool(torch.isfinite(torch.stack(figures)).all())


def _diverged(iteration: int, item: str) -> DivergedError:
    return DivergedError(
        f"training step {iteration}, {item}",
        expected="a finite loss and finite gradients",
        received="NaN or infinity",
        remedy="check its images, masks, parameters and cameras; lower the learning rates",
    )


def _means(outcomes: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Return the mean of every term over the outcomes that have it, in the order of first appearance."""
    columns: dict[str, list[Tensor]] = {}
    for figures in outcomes:
        for name, value in figures.items():
            columns.setdefault(name, []).append(value)
    return {name: torch.stack(values).mean() if values[1:] else values[0] for name, values in columns.items()}


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
