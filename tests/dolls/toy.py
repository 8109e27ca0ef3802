"""A training of milliseconds: a small network learns a curve from numbered batches."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any

import torch
from torch import Tensor

from avatar.training.engine.adam import OptimiserConfig, ParameterGroup
from avatar.training.engine.optimization_task import OptimizationTask
from avatar.training.engine.processes import Distributed


class Toy(OptimizationTask):
    """Batches of a step are numbered on; `odd` has a gradient from odd ones alone, `unused` from none.

    Args:
        seed: of the parameters at the start.
        batches: of a step.
        poison: numbers of batches whose loss is NaN.
    """

    def __init__(
        self,
        config: OptimiserConfig,
        distributed: Distributed | None = None,
        *,
        seed: int = 0,
        batches: int = 3,
        poison: Container[int] = (),
    ) -> None:
        random = torch.Generator().manual_seed(seed)
        shapes = {"first": (3, 16), "second": (16, 2), "odd": (2,), "unused": (4,)}
        p = {name: (0.5 * torch.randn(shape, generator=random)).requires_grad_() for name, shape in shapes.items()}
        super().__init__(
            [
                ParameterGroup("net", {name: p[name] for name in ("first", "second")}, lr=1e-2),
                ParameterGroup("offsets", {name: p[name] for name in ("odd", "unused")}, lr=2e-2, lr_final_factor=0.5),
            ],
            config,
            distributed,
        )
        self.p, self.batches, self.poison = p, batches, poison

    def micro_batches(self, iteration: int) -> list[int]:
        return [iteration * self.batches + k for k in range(self.batches)]

    def name_of(self, item: int) -> str:
        return f"batch {item}"

    def loss(self, item: int) -> tuple[Tensor, Mapping[str, Tensor]]:
        x = torch.randn((32, 3), generator=torch.Generator().manual_seed(item))
        y = torch.tanh(x @ self.p["first"]) @ self.p["second"]
        if item % 2:
            y = y + self.p["odd"]
        loss = (y - torch.sin(2.0 * x[:, :2])).square().mean()
        if item in self.poison:
            loss = loss * float("nan")
        return loss, {"loss": loss.detach(), **({"odd_loss": loss.detach()} if item % 2 else {})}

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        with torch.no_grad():
            return {"mean": {"loss": self.loss(-1)[0].item()}}


def same_state(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> bool:
    """Bit for bit."""
    return a.keys() == b.keys() and all(torch.equal(value, b[name]) for name, value in a.items())


def copied(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """As it is now."""
    return {name: value.detach().clone() for name, value in state.items()}
