"""Trainings by gradients: torch's own optimiser and schedulers agree, NaN changes nothing, state is exact."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avatar.training.engine.adam import Adam, OptimiserConfig, ParameterGroup
from avatar.training.engine.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from avatar.training.engine.optimization_task import DivergedError, OptimizationTask
from smplxpp.core.errors import InputError
from tests.dolls.toy import Toy, copied, same_state

CONFIG = OptimiserConfig(iterations=40)


class Single(OptimizationTask):
    """One parameter with a loss of its own."""

    def __init__(self, value: torch.Tensor, loss, config: OptimiserConfig = CONFIG, lr: float = 0.1) -> None:
        self.value, self.of = value.requires_grad_(), loss
        super().__init__([ParameterGroup("only", {"value": self.value}, lr)], config)

    def micro_batches(self, iteration: int) -> list[int]:
        return [iteration]

    def loss(self, item: int):
        loss = self.of(self.value)
        return loss, {"loss": loss.detach()}


def test_micro_batches_are_one_step_on_their_mean():
    """Against torch's Adam and its cosine on the mean loss of the same batches."""
    task, twin = Toy(CONFIG), Toy(CONFIG)
    net, offsets = [twin.p["first"], twin.p["second"]], [twin.p["odd"]]
    adam = [torch.optim.Adam(net, lr=1e-2), torch.optim.Adam(offsets, lr=2e-2)]
    rates = [
        torch.optim.lr_scheduler.CosineAnnealingLR(adam[0], 40, eta_min=0.05 * 1e-2),
        torch.optim.lr_scheduler.CosineAnnealingLR(adam[1], 40, eta_min=0.5 * 2e-2),
    ]
    for k in range(40):
        metrics = task.step(k)
        losses = torch.stack([twin.loss(item)[0] for item in twin.micro_batches(k)])
        for optimiser in adam:
            optimiser.zero_grad()
        losses.mean().backward()
        for optimiser, rate in zip(adam, rates, strict=True):
            optimiser.step()
            rate.step()
        assert metrics["loss"] == pytest.approx(losses.mean().item(), abs=1e-5)
        assert metrics["items"] == [f"batch {3 * k + j}" for j in range(3)]
    for name, value in task.p.items():
        torch.testing.assert_close(value, twin.p[name], rtol=0, atol=2e-5)


@pytest.mark.parametrize("decay", [0.0, 0.1])
def test_steps_are_those_of_torchs_classes_bit_for_bit(decay):
    """Which are not taken, as they import the compiler: a tensor without gradient is left out there, too."""
    draws = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=draws) for shape in ((3, 4), (5,), (2,))]
    own, theirs = ([torch.nn.Parameter(value.clone()) for value in start] for _ in range(2))
    groups = [{"params": own[:2], "lr": 0.1}, {"params": own[2:], "lr": 0.02}]
    adam = Adam(groups, betas=(0.8, 0.95), eps=1e-6, weight_decay=decay)
    made = torch.optim.AdamW if decay else torch.optim.Adam
    told = [{"params": theirs[:2], "lr": 0.1}, {"params": theirs[2:], "lr": 0.02}]
    twin = made(told, betas=(0.8, 0.95), eps=1e-6, weight_decay=decay, fused=True)
    for k in range(5):
        for group, other in zip(adam.param_groups, twin.param_groups, strict=True):
            group["lr"] = other["lr"] = 0.7 * group["lr"]
        for one, other in zip(own, theirs, strict=True):
            gradient = None if k == 0 and one.shape == (5,) else torch.randn(one.shape, generator=draws)
            one.grad, other.grad = gradient, None if gradient is None else gradient.clone()
        adam.step()
        twin.step()
        adam.zero_grad()
        assert all(value.grad is None for value in own)
        for one, other in zip(own, theirs, strict=True):
            assert torch.equal(one, other)
            assert all(torch.equal(adam.state[one][name], value) for name, value in twin.state[other].items())


def test_it_learns():
    task = Toy(OptimiserConfig(iterations=300))
    before = task.evaluate(0)["mean"]["loss"]
    for k in range(300):
        task.step(k)
    assert task.evaluate(300)["mean"]["loss"] < 0.6 * before


def test_numbers_are_means_over_the_items_that_have_them():
    task, twin = Toy(CONFIG), Toy(CONFIG)
    losses = [twin.loss(item)[0].item() for item in twin.micro_batches(1)]  # batches 3, 4, 5
    metrics = task.step(1)
    assert metrics["loss"] == pytest.approx(np.mean(losses))
    assert metrics["odd_loss"] == pytest.approx(np.mean([losses[0], losses[2]]))


def test_what_has_no_gradient_stays_and_has_no_moments():
    task = Toy(CONFIG, batches=2)
    before = copied(task.state())
    task.step(0)
    after = task.state()
    assert torch.equal(before["offsets.unused"], after["offsets.unused"])
    assert not any("unused" in key for key in after if key.startswith("adam."))
    assert {"adam.step.net.first", "adam.exp_avg.offsets.odd", "adam.exp_avg_sq.net.second"} <= after.keys()
    assert not torch.equal(before["offsets.odd"], after["offsets.odd"])


@pytest.mark.parametrize("final", [0.05, 1.0])
def test_schedules_begin_and_end_where_they_should(final):
    cosine = OptimiserConfig(iterations=80)
    assert [cosine.lr_factor(t, final) for t in (0, 40, 80)] == pytest.approx([1.0, (1.0 + final) / 2.0, final])
    exponential = OptimiserConfig(iterations=80, schedule="exponential")
    assert [exponential.lr_factor(t, final) for t in (0, 40, 80)] == pytest.approx([1.0, math.sqrt(final), final])
    constant = OptimiserConfig(iterations=80, schedule="constant")
    assert {constant.lr_factor(t, final) for t in range(81)} == {1.0}


@pytest.mark.parametrize("schedule", ["cosine", "exponential", "constant"])
def test_warming_up_rises_linearly_to_the_schedule(schedule):
    plain = OptimiserConfig(iterations=50, schedule=schedule)
    warm = OptimiserConfig(iterations=50, schedule=schedule, warmup=10)
    shares = [warm.lr_factor(t, 0.1) / plain.lr_factor(t, 0.1) for t in range(50)]
    assert shares == pytest.approx([min(1.0, (t + 1) / 10) for t in range(50)])


@pytest.mark.parametrize("max_grad_norm", [0.5, 1e9])
def test_clipping_shortens_all_gradients_together(max_grad_norm):
    """With a huge eps Adam's first step is the gradient's own length, `lr g / (|g| + eps)`."""
    start = torch.tensor([3.0, 4.0])
    gentle = OptimiserConfig(iterations=4, schedule="constant", eps=1e6, max_grad_norm=max_grad_norm)
    task = Single(start.clone(), lambda v: 0.5 * v.square().sum(), gentle, lr=1e6)
    task.step(0)
    moved = start - task.value.detach()
    torch.testing.assert_close(moved, start * min(1.0, max_grad_norm / 5.0), rtol=1e-4, atol=0)


def test_a_loss_that_is_not_a_number_changes_nothing_and_names_the_batch():
    task, clean = Toy(CONFIG, poison=(13,)), Toy(CONFIG)
    for k in range(4):
        task.step(k), clean.step(k)
    before = copied(task.state())
    with pytest.raises(DivergedError, match=r"training step 4, batch 13: expected a finite loss") as caught:
        task.step(4)
    assert "learning rates" in caught.value.remedy
    assert same_state(before, task.state())
    task.poison = ()
    task.step(4), clean.step(4)
    assert same_state(clean.state(), task.state())


def test_a_gradient_that_is_infinite_is_found_behind_a_finite_loss():
    task = Single(torch.zeros(3), lambda v: v.abs().sum().sqrt())
    with pytest.raises(DivergedError, match="step 7, 7"):
        task.step(7)
    assert torch.equal(task.value.detach(), torch.zeros(3))


def test_a_restored_task_goes_on_bit_for_bit(tmp_path):
    whole = Toy(CONFIG)
    for k in range(20):
        whole.step(k)
    half = Toy(CONFIG)
    for k in range(11):
        half.step(k)
    save_checkpoint(tmp_path / "state", Checkpoint(11, 0.0, "k", half.state()))
    other = Toy(CONFIG, seed=5)
    other.step(0)
    other.restore(load_checkpoint(tmp_path / "state", key="k").tensors)
    assert same_state(half.state(), other.state())
    for k in range(11, 20):
        other.step(k)
    assert same_state(whole.state(), other.state())


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("net.first", None, "received none"),
        ("net.first", lambda value: value[..., None], "of shape"),
        ("net.first", lambda value: value.int(), "integers"),
        ("net.first", lambda value: value * math.nan, "finite"),
        ("adam.exp_avg.net.first", None, "received none"),
        ("adam.exp_avg_sq.net.first", lambda value: value * math.inf, "finite"),
        ("adam.step.net.first", lambda value: value[None], "of shape"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_by_name_and_nothing_is_taken(name, change, words):
    task, other = Toy(CONFIG), Toy(CONFIG)
    task.step(0)
    state = {key: value.detach().clone() for key, value in task.state().items()}
    assert name in state
    state = {key: value for key, value in state.items() if key != name or change}
    if change:
        state[name] = change(state[name])
    before = {key: value.detach().clone() for key, value in other.state().items()}
    with pytest.raises(InputError, match=f"{name}.*{words}"):
        other.restore(state)
    assert all(torch.equal(value, before[key]) for key, value in other.state().items())


def test_restoring_keeps_to_itself():
    task, other = Toy(CONFIG), Toy(CONFIG, seed=1)
    task.step(0)
    other.restore(task.state())
    kept = copied(task.state())
    other.step(1)
    assert same_state(kept, task.state())


def test_moments_lie_as_their_parameter_does(tmp_path):
    """Files hold contiguous tensors; the fused optimiser walks a parameter and its moments in memory's order."""
    weight = torch.randn((4, 3, 3, 3), generator=torch.Generator().manual_seed(0))
    goal = torch.randn((4, 3, 3, 3), generator=torch.Generator().manual_seed(1))

    def task() -> Single:
        return Single(weight.clone().contiguous(memory_format=torch.channels_last), lambda v: (v - goal).pow(2).sum())

    whole, parts = task(), task()
    for k in range(6):
        whole.step(k)
    for k in range(3):
        parts.step(k)
    save_checkpoint(tmp_path / "state", Checkpoint(3, 0.0, "k", parts.state()))
    again = task()
    again.restore(load_checkpoint(tmp_path / "state", key="k").tensors)
    for k in range(3, 6):
        again.step(k)
    assert torch.equal(whole.value, again.value)


def test_networks_stay_in_float32_on_the_cpu():
    task = Toy(OptimiserConfig(iterations=1, amp=True))
    with task.autocast():
        assert (task.p["first"].T @ task.p["first"]).dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA")
def test_networks_are_in_bfloat16_on_cuda_where_wanted():
    for amp, kind in ((True, torch.bfloat16), (False, torch.float32)):
        task = Single(torch.ones((8, 8), device="cuda"), None, OptimiserConfig(iterations=1, amp=amp))

        def loss(value, task=task, kind=kind):
            with task.autocast():
                out = value @ value
            assert out.dtype == kind
            return out.float().square().mean()

        task.of = loss
        task.step(0)
        assert task.value.dtype == task.value.grad.dtype == torch.float32


@pytest.mark.parametrize(
    "change",
    [
        {"iterations": 0},
        {"schedule": "linear"},
        {"warmup": -1},
        {"betas": (0.9, 1.0)},
        {"betas": (-0.1, 0.9)},
        {"eps": 0.0},
        {"eps": math.nan},
        {"max_grad_norm": 0.0},
        {"max_grad_norm": math.nan},
    ],
)
def test_choices_out_of_range_are_refused_by_name(change):
    with pytest.raises(InputError, match=f"optimiser: {next(iter(change))}"):
        OptimiserConfig(**{"iterations": 10, **change})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lr": 0.0}, "learning rate net"),
        ({"lr": math.inf}, "learning rate net"),
        ({"lr_final_factor": 0.0}, "final learning rate net"),
        ({"lr_final_factor": 1.5}, "final learning rate net"),
    ],
)
def test_rates_out_of_range_are_refused_by_the_groups_name(change, words):
    with pytest.raises(InputError, match=words):
        ParameterGroup(**{"name": "net", "parameters": {"a": torch.zeros(2).requires_grad_()}, "lr": 1.0, **change})
