"""The mean over the last steps: what a training ends with, whether or not it was cut in two."""

from __future__ import annotations

import math

import pytest
import torch

from avatar.training.engine.adam import EVERY, MeanOfSteps, OptimiserConfig
from avatar.training.engine.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from smplxpp.core.errors import InputError
from tests.dolls.toy import Toy, copied, same_state

STEPS = 60
AVERAGED = OptimiserConfig(iterations=STEPS, averaged=0.7)


def trained(task: Toy, begin: int = 0, end: int = STEPS) -> Toy:
    for k in range(begin, end):
        task.step(k)
    return task


@pytest.mark.parametrize("share", [0.7, 1.0, 0.4])
def test_a_training_ends_with_the_mean_of_every_tenth_of_its_last_steps(share):
    """Against a twin without a mean whose parameters are written down after every step."""
    plain = Toy(OptimiserConfig(iterations=STEPS))
    passed = []
    for k in range(STEPS):
        plain.step(k)
        passed.append({name: value.detach().clone() for name, value in plain.p.items()})
    counted = passed[STEPS - round(share * STEPS) :: EVERY]
    task = trained(Toy(OptimiserConfig(iterations=STEPS, averaged=share)))
    for name, value in task.p.items():
        expected = torch.stack([step[name] for step in counted]).double().mean(dim=0)
        torch.testing.assert_close(value.detach().double(), expected, rtol=0, atol=1e-6)


def test_the_steps_themselves_do_not_feel_the_mean():
    task, plain = (trained(Toy(config), end=STEPS - 1) for config in (AVERAGED, OptimiserConfig(iterations=STEPS)))
    assert all(torch.equal(value, plain.p[name]) for name, value in task.p.items())


def test_without_a_share_nothing_is_kept_or_changed():
    task = trained(Toy(OptimiserConfig(iterations=STEPS, averaged=0.0)))
    assert not any(key.startswith("mean.") for key in task.state())


@pytest.mark.parametrize("cut", [5, 18, 19, 41, STEPS - 1])
def test_a_training_that_was_cut_in_two_ends_bit_for_bit_as_a_whole_one(cut, tmp_path):
    """Before the first step that counts (18), right after it, between two that count, before the last."""
    first = trained(Toy(AVERAGED), end=cut)
    save_checkpoint(tmp_path / "state", Checkpoint(cut, 0.0, "k", first.state()))
    second = Toy(AVERAGED, seed=5)
    second.restore(load_checkpoint(tmp_path / "state", key="k").tensors)
    assert same_state(trained(Toy(AVERAGED)).state(), trained(second, begin=cut).state())


@pytest.mark.parametrize(
    ("change", "words"),
    [(None, "received none"), (lambda value: value[..., None], "of shape"), (lambda value: value * math.nan, "finite")],
)
def test_a_mean_that_does_not_fit_is_refused_and_nothing_is_taken(change, words):
    name = "mean.net.first"
    state = {key: value.detach().clone() for key, value in trained(Toy(AVERAGED), end=30).state().items()}
    state = {key: value for key, value in state.items() if key != name or change}
    if change:
        state[name] = change(torch.ones_like(state["net.first"]))
    other = trained(Toy(AVERAGED), end=25)
    before = copied(other.state())
    with pytest.raises(InputError, match=f"{name}.*{words}"):
        other.restore(state)
    assert same_state(before, other.state())


def test_a_mean_is_a_copy():
    learned = {"a": torch.ones(3)}
    mean = MeanOfSteps(learned, iterations=20, share=1.0)
    mean.after(0)
    learned["a"] += 1.0
    assert torch.equal(mean.state()["mean.a"], torch.ones(3))


@pytest.mark.parametrize("share", [-0.1, 1.1, math.nan])
def test_a_share_out_of_range_is_refused(share):
    with pytest.raises(InputError, match="optimiser: averaged"):
        OptimiserConfig(iterations=10, averaged=share)
