"""Base of all trainings: Adam on micro-batches, schedules, a stop at the first NaN, exact resumption."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import torch
from torch import Tensor

from avatar.gaussians.tensor_file import require_finite, require_like
from avatar.training.engine.processes import Distributed
from smplxpp.core import InputError, require_at_least, require_between, require_choice, require_positive

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


Batch = TypeVar("Batch")
_START_AGAIN = "delete the file of its state, or give --force, to start again"
MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class DivergedError(InputError):
    """A loss or gradient is not finite. Parameters and the last checkpoint are as before the step."""


@dataclass(frozen=True, kw_only=True)
class OptimiserConfig:
    """Adam and its learning rates over a training of T steps.

    Attributes:
        iterations: T.
        schedule: factor on a group's rate at step t, counted from 0. With f the group's `lr_final_factor`:
            cosine `f + (1 - f) (1 + cos(pi t / T)) / 2` (Loshchilov and Hutter 2017), exponential `f^(t / T)`,
            constant 1.
        warmup: steps over which the rates also rise linearly from `1 / warmup` to 1; 0 for none.
        betas: decay rates of Adam's moments.
        eps: of Adam.
        max_grad_norm: largest norm of all gradients together; larger ones are scaled down to it.
        averaged: share of the last steps over which the parameters are averaged at the end (`MeanOfSteps`).
        amp: networks in bfloat16 on CUDA, where the task says so with `OptimizationTask.autocast`. bfloat16 has
            float32's range, so that no gradient needs scaling. Without effect on the CPU.
    """

    iterations: int
    schedule: Literal["cosine", "exponential", "constant"] = "cosine"
    warmup: int = 0
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8
    max_grad_norm: float = math.inf
    averaged: float = 0.0
    amp: bool = False

    def __post_init__(self) -> None:
        require_choice("optimiser: schedule", self.schedule, ("cosine", "exponential", "constant"))
        require_at_least("optimiser: iterations", self.iterations, 1)
        require_at_least("optimiser: warmup", self.warmup, 0)
        require_positive("optimiser: eps", self.eps)
        require_between("optimiser: averaged", self.averaged, 0.0, 1.0)
        require_positive("optimiser: max_grad_norm", self.max_grad_norm, finite=False)
        if not all(0.0 <= beta < 1.0 for beta in self.betas):
            raise InputError("optimiser: betas", expected="two numbers in [0, 1)", received=repr(self.betas))

    def lr_factor(self, iteration: int, lr_final_factor: float) -> float:
        """Return the share of a rate that is left at a step counted from 0."""
        # Share of the training that is done; the warm-up multiplies whatever the schedule gives.
        at = iteration / self.iterations
        rising = min(1.0, (iteration + 1) / self.warmup) if self.warmup else 1.0
        if self.schedule == "cosine":
            return rising * (lr_final_factor + (1.0 - lr_final_factor) * 0.5 * (1.0 + math.cos(math.pi * at)))
        return rising * (lr_final_factor**at if self.schedule == "exponential" else 1.0)


@dataclass(frozen=True, eq=False)
class ParameterGroup:
    """Tensors that one learning rate moves.

    Attributes:
        name: with the tensor's own, `name.own`, its key in checkpoints. Groups may share a name, not a key.
        parameters: leaves that require a gradient, all of one device.
        lr: Adam's step at the start.
        lr_final_factor: share of it left at the end; the schedule says how it gets there.
    """

    name: str
    parameters: Mapping[str, Tensor]
    lr: float
    lr_final_factor: float = 0.05

    def __post_init__(self) -> None:
        assert all(value.is_leaf and value.requires_grad for value in self.parameters.values()), self.name
        require_positive(f"learning rate {self.name}", self.lr)
        if not 0.0 < self.lr_final_factor <= 1.0:
            raise InputError(
                f"final learning rate {self.name}", expected="a share in (0, 1]", received=repr(self.lr_final_factor)
            )


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
        self.optimiser = torch.optim.Adam(
            [{"params": list(group.parameters.values()), "lr": group.lr} for group in groups],
            betas=config.betas,
            eps=config.eps,
            fused=True,
        )
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
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=enabled)

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
        self.optimiser.zero_grad(set_to_none=True)
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
        # Messages between processes do not carry tensors of a GPU.
        return figures if self.distributed.world_size == 1 else {name: one.cpu() for name, one in figures.items()}


def _copy_in_layout(content: Tensor, parameter: Tensor) -> Tensor:
    """Return a copy with the parameter's device and memory layout, because fused Adam walks both together."""
    if content.shape != parameter.shape:  # the number of steps
        return content.to(parameter.device, copy=True)
    return torch.empty_like(parameter).copy_(content)


def _finite(values: Iterable[Tensor]) -> bool:
    """Return whether all values are finite: the largest magnitude is NaN or infinite when any of them is."""
    # One call for all tensors, which is a few launches on a GPU, and one transfer of the answer.
    largest = torch._foreach_norm([value.detach() for value in values], ord=torch.inf)
    return bool(torch.isfinite(torch.stack(largest)).all())


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
