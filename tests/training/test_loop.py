"""The loop: metrics, evaluations, time, checkpoints; an interrupted training is the uninterrupted one."""

from __future__ import annotations

import itertools
import json
import math

import pytest
import torch

from avatar.training import loop as module
from avatar.training.loop import DivergedError, LoopConfig, require_finite, run_training
from avatar.training.metrics_log import append_metrics, read_metrics, truncate_metrics


class Walk:
    """A random walk with momentum: where it ends tells every step that was made."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.place, self.speed, self.stop_at = torch.zeros(4), torch.zeros(4), stop_at

    def step(self, iteration: int) -> dict:
        if iteration == self.stop_at:
            raise KeyboardInterrupt
        push = torch.randn(4, generator=torch.Generator().manual_seed(iteration))
        self.speed = 0.9 * self.speed + push
        self.place = self.place + self.speed
        return {"loss": float(self.place.norm()), "view": f"v{iteration % 3}"}

    def evaluate(self, iteration: int) -> dict:
        return {"mean": {"psnr": float(self.place.sum())}, "held_out": True}

    def state(self) -> dict:
        return {"place": self.place, "speed": self.speed}

    def restore(self, tensors) -> None:
        self.place, self.speed = tensors["place"].clone(), tensors["speed"].clone()


def config(**changes) -> LoopConfig:
    return LoopConfig(**{"iterations": 25, "log_every": 4, "evaluate_every": 10, "checkpoint_seconds": 0.0, **changes})


def without_times(entries: list[dict]) -> list[dict]:
    return [{k: v for k, v in e.items() if k not in ("seconds", "iterations_per_second")} for e in entries]


def test_what_is_logged_and_when(tmp_path):
    seen = []
    end = run_training(Walk(), config(), tmp_path, key="k", report=seen.append)
    entries = read_metrics(tmp_path / "metrics.jsonl")
    assert [e["iteration"] for e in entries if e["kind"] == "step"] == [4, 8, 12, 16, 20, 24, 25]
    assert [e["iteration"] for e in entries if e["kind"] == "evaluation"] == [0, 10, 20, 25]
    assert [p.iteration for p in seen if p.evaluation] == [0, 10, 20, 25]
    assert end.finished and end.iteration == 25 and end.rate > 0
    assert all(a["seconds"] <= b["seconds"] for a, b in itertools.pairwise(entries))


@pytest.mark.parametrize("killed_at", [3, 10, 17])
def test_a_killed_training_ends_where_the_whole_one_does(tmp_path, killed_at):
    whole = Walk()
    run_training(whole, config(), tmp_path / "whole", key="k")
    with pytest.raises(KeyboardInterrupt):
        run_training(Walk(stop_at=killed_at), config(), tmp_path / "parts", key="k")
    second = Walk()
    end = run_training(second, config(), tmp_path / "parts", key="k")
    assert torch.equal(second.place, whole.place) and end.iteration == 25
    logs = [without_times(read_metrics(tmp_path / name / "metrics.jsonl")) for name in ("whole", "parts")]
    assert logs[0] == logs[1]


def test_steps_after_the_last_checkpoint_are_forgotten_and_done_again(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_training(Walk(stop_at=9), config(checkpoint_seconds=math.inf), tmp_path, key="k")
    walk = Walk()
    run_training(walk, config(checkpoint_seconds=math.inf), tmp_path, key="k")
    steps = [e["iteration"] for e in read_metrics(tmp_path / "metrics.jsonl") if e["kind"] == "step"]
    assert steps == [4, 8, 12, 16, 20, 24, 25]
    whole = Walk()
    run_training(whole, config(), tmp_path / "whole", key="k")
    assert torch.equal(walk.place, whole.place)


def test_a_limit_of_time_stops_with_a_checkpoint_and_the_next_call_goes_on(tmp_path):
    for call in range(1, 26):  # one step a call
        walk = Walk()
        end = run_training(walk, config(max_seconds=1e-12), tmp_path, key="k")
        assert (end.iteration, end.finished) == (call, call == 25)
    whole = Walk()
    run_training(whole, config(), tmp_path / "whole", key="k")
    assert torch.equal(walk.place, whole.place)


def test_a_checkpoint_of_another_key_is_not_taken_up(tmp_path):
    run_training(Walk(), config(max_seconds=1e-12), tmp_path, key="old")
    end = run_training(Walk(), config(max_seconds=1e-12), tmp_path, key="new")
    assert end.iteration == 1
    assert [e["iteration"] for e in read_metrics(tmp_path / "metrics.jsonl")] == [0]


def test_a_number_that_is_not_finite_stops_and_names_the_view():
    fine = torch.ones(3)
    require_finite([fine, fine], iteration=4, view="Cam7")
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(DivergedError, match=r"step 4, view Cam7") as caught:
            require_finite([fine, torch.tensor([0.0, bad])], iteration=4, view="Cam7")
        assert "learning rates" in caught.value.remedy


def test_diverging_keeps_the_last_checkpoint(tmp_path):
    class Diverging(Walk):
        def step(self, iteration: int) -> dict:
            require_finite([torch.tensor(math.nan if iteration == 6 else 1.0)], iteration=iteration, view="x")
            return super().step(iteration)

    with pytest.raises(DivergedError):
        run_training(Diverging(), config(), tmp_path, key="k")
    assert module.load_checkpoint(tmp_path / module.STATE_FILE, key="k").iteration == 6


def test_metrics_survive_a_line_that_was_cut_short(tmp_path):
    path = tmp_path / "metrics.jsonl"
    for k in range(4):
        append_metrics(path, {"iteration": k, "loss": math.nan if k == 1 else 0.5})
    path.write_text(path.read_text() + '{"iteration": 4, "lo')
    assert [e["iteration"] for e in read_metrics(path)] == [0, 1, 2, 3]
    assert read_metrics(path)[1]["loss"] is None
    truncate_metrics(path, 2)
    assert [json.loads(line)["iteration"] for line in path.read_text().splitlines()] == [0, 1, 2]
    assert read_metrics(tmp_path / "none") == []
