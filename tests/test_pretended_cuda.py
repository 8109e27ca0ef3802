"""The pretended device refuses what CUDA refuses, and computes what the CPU computes."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
import torch
from torch import nn

from tests.pretended_cuda import PretendedTensor, pretended_cuda

MIXED = "same device"


@pytest.fixture(autouse=True)
def device():
    with pretended_cuda():
        yield


def test_tensors_are_made_on_it_by_every_way():
    here = torch.ones(3, device="cuda")
    made = [
        torch.tensor([1.0, 2.0], device=here.device),
        torch.as_tensor(np.ones(2), device="cuda"),
        torch.arange(3, device=here.device),
        torch.from_numpy(np.ones(2)).to(here.device, torch.float32),
        torch.ones(2).cuda(),
        here.new_zeros(2),
        here.new_tensor([1.0]),
        torch.zeros_like(here),
        here[1:],
        deepcopy(here),
    ]
    assert all(type(one) is PretendedTensor and one.is_cuda and one.device.type == "cuda" for one in made)
    assert type(here.cpu()) is torch.Tensor and here.cpu().device.type == "cpu"
    assert torch.from_numpy(np.ones(2)).device.type == "cpu"
    with torch.device("meta"):
        assert nn.Linear(2, 2).weight.is_meta  # what is really to have no numbers has none


@pytest.mark.parametrize(
    "mix",
    [
        lambda a, b: a + b,
        lambda a, b: torch.zeros(1, 1) * a[:, None],
        lambda a, b: torch.where(a > 0, a, b),
        lambda a, b: torch.cat([a, b]),
        lambda a, b: torch.stack([a[0], b[0]]),
        lambda a, b: b.add_(a),
        lambda a, b: torch.einsum("i,i->", a, b),
        lambda a, b: torch.searchsorted(a, b),
        lambda a, b: a.index_select(0, torch.tensor([0])),
        lambda a, b: nn.functional.mse_loss(a, b),
    ],
)
def test_mixing_is_refused(mix):
    with pytest.raises(RuntimeError, match=MIXED):
        mix(torch.ones(3, device="cuda"), torch.ones(3))


def test_what_cuda_allows_is_allowed():
    here, there = torch.arange(3.0, device="cuda"), torch.arange(3.0)
    assert (here * torch.tensor(2.0)).tolist() == [0.0, 2.0, 4.0]  # a number
    assert here[torch.tensor([2, 0])].tolist() == [2.0, 0.0]  # the CPU's indices
    here.copy_(torch.ones(3))
    there.copy_(here)
    assert here.tolist() == there.tolist() == [1.0, 1.0, 1.0]
    assert float(here.sum()) == 3.0


def test_the_cpus_tensors_take_no_indices_of_it():
    with pytest.raises(RuntimeError, match="indices"):
        torch.ones(3)[torch.tensor([0], device="cuda")]


@pytest.mark.parametrize("ask", [lambda a: a.numpy(), np.asarray, lambda a: np.ones(2) * np.asarray(a)])
def test_it_gives_no_arrays(ask):
    with pytest.raises(TypeError, match="numpy"):
        ask(torch.ones(2, device="cuda"))


def test_generators_of_the_cpu_are_refused():
    with pytest.raises(RuntimeError, match="generator"):
        torch.randn(3, generator=torch.Generator(), device="cuda")
    with pytest.raises(RuntimeError, match="generator"):
        torch.zeros(3, device="cuda").normal_(generator=torch.Generator())


def test_modules_learn_on_it_what_they_learn_on_the_cpu():
    own = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
    moved = deepcopy(own).to("cuda")
    x = torch.randn(5, 3)
    for module, given in ((own, x), (moved, x.to("cuda"))):
        optimiser = torch.optim.Adam(module.parameters(), lr=0.1)
        for _ in range(3):
            optimiser.zero_grad()
            module(given).square().mean().backward()
            optimiser.step()
    assert all(isinstance(p, nn.Parameter) and p.is_cuda for p in moved.parameters())
    for one, other in zip(own.parameters(), moved.parameters(), strict=True):
        torch.testing.assert_close(other.detach().cpu(), one.detach())
    with pytest.raises(RuntimeError, match=MIXED):
        moved(x)


def test_gradients_cross_over():
    x = torch.ones(2, requires_grad=True)
    (3.0 * (2.0 * x.to("cuda")).cpu()).sum().backward()
    assert x.grad is not None and type(x.grad) is torch.Tensor and x.grad.tolist() == [6.0, 6.0]
