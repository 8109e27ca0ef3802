"""Adam, its learning rates over a training, and the mean of the last steps."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam
from torch.optim.adamw import adamw

from avatar.data.sequence import FrameSequence
from avatar.gaussians.tensor_file import require_finite, require_like
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from smplxpp.core import InputError, require_at_least, require_between, require_choice, require_positive

EVERY = 10
"""Steps between two that enter the mean: neighbours differ little, and a mean of every step would cost time."""
MOMENTS = ("step", "exp_avg", "exp_avg_sq")
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


class Adam:
    """Adam (Kingma and Ba 2015), with decoupled decay AdamW (Loshchilov and Hutter 2019), by torch's functions.

    The steps are those of torch's classes with `fused=True`, one kernel for all parameters, bit for bit. The classes
    import torch's compiler, which costs every process 1.4 s and 70 MB.

    Args:
        groups: parameters by learning rate, as torch's optimisers take them: "params" and "lr".
        betas: decay rates of the moments.
        eps: added to the root of the second moment.
        weight_decay: decay of the parameters a step, as a multiple of the rate; 0 is plain Adam.

    Attributes:
        param_groups: the groups; their "lr" is read in every step.
        state: "step", "exp_avg" and "exp_avg_sq" of each parameter that has taken a step.
    """

    def __init__(
        self,
        groups: Sequence[dict[str, Any]],
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
    ) -> None:
        self.param_groups, self.state = list(groups), defaultdict[Tensor, dict[str, Tensor]](dict)
        self._betas, self._eps, self._decay = betas, eps, weight_decay

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for group in self.param_groups:
            for value in group["params"]:
                value.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move the parameters that have a gradient; others have no moments and stay."""
        for group in self.param_groups:
            used = [value for value in group["params"] if value.grad is not None]
            for value in used:
                if not self.state[value]:
                    self.state[value] = {
                        "step": torch.zeros((), device=value.device),
                        "exp_avg": torch.zeros_like(value),
                        "exp_avg_sq": torch.zeros_like(value),
                    }
            steps, means, squares = ([self.state[value][name] for value in used] for name in MOMENTS)
            (adamw if self._decay else adam)(
                used,
                [value.grad for value in used],
                means,
                squares,
                [],
                steps,
                foreach=False,
                fused=True,
                amsgrad=False,
                beta1=self._betas[0],
                beta2=self._betas[1],
                lr=group["lr"],
                weight_decay=self._decay,
                eps=self._eps,
                maximize=False,
            )


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


@dataclass(frozen=True, kw_only=True)
class LearningRates:
    """Learning rate of every attribute at the start; all fall exponentially to `lr_final_factor` times that.

    Attributes:
        normal_offset: pixels along the normal, which silhouettes determine. A pixel is the median over the training
            views of its size at the person, so that the rate fits any distance and image size.
        offset: pixels in every direction; slow, so that texture stays where several views agree on it.
        log_scales: of the logarithms of scales in the triangle's frame.
        quats: of the quaternions' components.
        opacity_logits: of the logits of opacities.
        dc: of colours in [0, 1].
        sh: of the harmonics' coefficients that depend on the view.
        lr_final_factor: share of all rates left at the last step.
    """

    normal_offset: float = 0.1
    offset: float = 0.015
    log_scales: float = 5e-3
    quats: float = 2e-3
    opacity_logits: float = 3e-2
    dc: float = 2e-3
    sh: float = 5e-4
    lr_final_factor: float = 0.1

    def __post_init__(self) -> None:
        for f in fields(self):
            require_positive(f"learning rate {f.name}", getattr(self, f.name))


def attribute_groups(
    gaussians: LearnedGaussians, multiple: float, pixel: float, rates: LearningRates
) -> list[ParameterGroup]:
    """Return parameter groups of the Gaussians' attributes at `multiple` times `rates`; none for 0, which freezes them.

    Args:
        gaussians: whose attributes learn.
        multiple: factor on all rates.
        pixel: size of a pixel at the person, metres, the unit of the offsets' rates.
        rates: of the attributes.
    """
    if not multiple:
        gaussians.requires_grad_(False)
        return []
    # Rates of offsets are in pixels, all others in the attribute's own unit.
    unit = {"normal_offset": pixel, "offset": pixel}
    gaussians.requires_grad_(True)
    return [
        ParameterGroup(
            f"gaussians.{name}",
            {name: getattr(gaussians, name)},
            multiple * getattr(rates, name) * unit.get(name, 1.0),
            rates.lr_final_factor,
        )
        for name in LEARNED
        if getattr(gaussians, name).numel()
    ]


def pixel_size(sequence: FrameSequence) -> float:
    """Return the size of a pixel at the person, metres: the median of `distance / f` over the training cameras."""
    # A pixel at distance d has the size d / f, f the focal length in pixels.
    center = sequence.person_center()
    cameras = [sequence.camera(name) for name in sequence.train_cameras]
    return float(np.median([np.linalg.norm(c.position - center) / c.K[0, 0] for c in cameras]))
