"""The loop: metrics, evaluations, time, checkpoints; an interrupted training is the uninterrupted one."""

from __future__ import annotations

import errno
import itertools
import json
import math
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.training.engine import checkpoints
from avatar.training.engine import loop as module
from avatar.training.engine.adam import OptimiserConfig
from avatar.training.engine.checkpoints import (
    STATE_FILE,
    Checkpoint,
    CheckpointWriter,
    load_checkpoint,
    save_checkpoint,
)
from avatar.training.engine.loop import LoopConfig, run_training
from avatar.training.engine.metrics_log import append_metrics, read_metrics, truncate_metrics
from avatar.training.engine.optimization_task import DivergedError
from avatar.training.engine.processes import Distributed
from smplxpp.core.errors import InputError, MissingExtraError
from tests.dolls.toy import Toy, same_state


class Walk:
    """A random walk with momentum: where it ends tells every step that was made.

    Args:
        stop_at: step that is not made: `error` is raised.
    """

    distributed = Distributed()

    def __init__(self, stop_at: int | None = None, error: BaseException | None = None) -> None:
        self.place, self.speed, self.stop_at = torch.zeros(4), torch.zeros(4), stop_at
        self.error = error or KeyboardInterrupt()

    def step(self, iteration: int) -> dict:
        if iteration == self.stop_at:
            raise self.error
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


def test_a_checkpoint_of_another_key_stops_before_anything_is_lost(tmp_path):
    run_training(Walk(), config(max_seconds=1e-12), tmp_path, key="old")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=r"state\.safetensors: .* at iteration 1.*--force"):
        run_training(Walk(), config(), tmp_path, key="new")
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert run_training(Walk(), config(max_seconds=1e-12), tmp_path, key="old").iteration == 2


def test_what_a_kill_left_half_written_is_cleared(tmp_path):
    run_training(Walk(), config(max_seconds=1e-12), tmp_path, key="k")
    (tmp_path / f".{STATE_FILE.replace('.', '.x7_a.')}").write_bytes(b"half")
    (tmp_path / ".metrics.12ab.jsonl").write_text("half")
    run_training(Walk(), config(), tmp_path, key="k")
    assert {path.name for path in tmp_path.iterdir()} == {module.METRICS_FILE, STATE_FILE}


@pytest.mark.parametrize(
    ("poison", "words", "kept"),
    [
        (range(20, 99), "step 8, batch 24", 8),  # the third step in a row
        ({3, 9, 15, 21}, "step 7, batch 21", 7),  # four of 25 steps
    ],
)
def test_diverging_often_keeps_the_last_checkpoint(tmp_path, poison, words, kept):
    with pytest.raises(DivergedError, match=words):
        run_training(Toy(OptimiserConfig(iterations=25), poison=poison), config(), tmp_path, key="k")
    assert load_checkpoint(tmp_path / STATE_FILE, key="k").iteration == kept


def test_a_step_that_diverges_is_left_out_and_halves_the_rates_once(tmp_path, caplog):
    class Counted(Toy):
        halved = 0

        def halve_rates(self) -> None:
            self.halved += 1
            super().halve_rates()

    optimiser, poison = OptimiserConfig(iterations=25), (10, 40)
    whole = Counted(optimiser, poison=poison)
    assert run_training(whole, config(), tmp_path / "whole", key="k").finished
    assert whole.halved == 1
    said = [record.message for record in caplog.records if "left out" in record.message]
    assert len(said) == 2
    assert said[0].startswith("training step 3, batch 10 is left out") and said[0].endswith("rates are halved")
    assert not said[1].endswith("rates are halved")
    # A training that was stopped after the first of them goes on with the halved rates.
    stopped = run_training(Toy(optimiser, poison=poison), config(max_seconds=1e-12), tmp_path / "parts", key="k")
    while not stopped.finished:
        part = Toy(optimiser, poison=poison)
        stopped = run_training(part, config(max_seconds=1e-12), tmp_path / "parts", key="k")
    assert same_state(part.state(), whole.state())
    steady = Toy(optimiser)
    run_training(steady, config(), tmp_path / "steady", key="k")
    assert not same_state(steady.state(), whole.state())


@pytest.mark.parametrize("step", [10, 19])
def test_a_mean_begins_and_ends_with_steps_that_diverge(tmp_path, step):
    """Of the steps from 10 to 19: 10 is the first that enters the mean, and 19 puts it into the parameters."""
    optimiser = OptimiserConfig(iterations=20, averaged=0.5)
    task = Toy(optimiser, poison=(3 * step,))
    assert run_training(task, config(iterations=20), tmp_path, key="k").finished
    assert set(task.mean.mean) == set(task.learned)
    assert all(torch.equal(task.learned[key].detach(), mean) for key, mean in task.mean.mean.items())


def test_a_checkpoint_is_of_its_moment_though_the_steps_go_on(tmp_path, monkeypatch):
    slow = threading.Event()

    def delayed(path, checkpoint):
        assert slow.wait(60)
        save_checkpoint(path, checkpoint)

    monkeypatch.setattr(checkpoints, "save_checkpoint", delayed)
    writer, place = CheckpointWriter(tmp_path / STATE_FILE), torch.ones(3)
    writer.write(Checkpoint(5, 1.0, "k", {"place": place}))
    place += 1.0
    slow.set()
    writer.finish()
    writer.close()
    assert torch.equal(load_checkpoint(tmp_path / STATE_FILE, key="k").tensors["place"], torch.ones(3))


def test_checkpoints_take_a_share_of_the_time(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "save_checkpoint", lambda path, checkpoint: time.sleep(0.02))
    writer = CheckpointWriter(tmp_path / STATE_FILE, share=0.02, least_seconds=0.5)
    first, second = (writer.write(Checkpoint(k, 1.0, "k", {})) for k in (1, 2))
    writer.close()
    assert 0.5 <= first and 1.0 <= second


def too_much_memory(empty) -> Exception:
    """What a library raises that is asked for an exabyte."""
    with pytest.raises((RuntimeError, MemoryError)) as caught:
        empty((1 << 56, 4))
    return caught.value


@pytest.mark.parametrize("kind", ["cpu", "cuda", "numpy", "python"])
def test_running_out_of_memory_says_what_to_do_and_keeps_the_last_checkpoint(tmp_path, kind):
    errors = {
        "cpu": too_much_memory(torch.empty),
        "cuda": torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nmore"),
        "numpy": too_much_memory(np.empty),
        "python": MemoryError(),
    }
    with pytest.raises(InputError, match="memory: expected room") as caught:
        run_training(Walk(9, errors[kind]), config(), tmp_path, key="k")
    assert "smaller preset" in caught.value.remedy and caught.value.received and "\n" not in caught.value.received
    whole, second = Walk(), Walk()
    assert load_checkpoint(tmp_path / STATE_FILE, key="k").iteration == 9
    run_training(second, config(), tmp_path, key="k")
    run_training(whole, config(), tmp_path / "whole", key="k")
    assert torch.equal(whole.place, second.place)


@pytest.mark.parametrize("error", [RuntimeError("shapes differ"), PermissionError(errno.EACCES, "not allowed")])
def test_other_errors_pass_as_they_are(tmp_path, error):
    with pytest.raises(type(error)) as caught:
        run_training(Walk(3, error), config(), tmp_path, key="k")
    assert caught.value is error


def test_a_full_disk_says_so_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    write, written = Path.write_bytes, []

    def full(path, data):
        written.append(path)
        if len(written) == 8:
            write(path, data[:50])
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, data)

    with monkeypatch.context() as patch, pytest.raises(InputError, match="No space left on device") as caught:
        patch.setattr(Path, "write_bytes", full)
        run_training(Walk(), config(), tmp_path, key="k")
    assert str(tmp_path) in caught.value.subject and "free some space" in caught.value.remedy
    assert sorted(path.name for path in tmp_path.iterdir()) == [module.METRICS_FILE, STATE_FILE]
    assert load_checkpoint(tmp_path / STATE_FILE, key="k").iteration == 7
    whole, second = Walk(), Walk()
    run_training(second, config(), tmp_path, key="k")
    run_training(whole, config(), tmp_path / "whole", key="k")
    assert torch.equal(whole.place, second.place)


def test_tensorboard_is_named_where_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(MissingExtraError, match=r"extra tensorboard"):
        run_training(Walk(), config(tensorboard=True), tmp_path, key="k")


def test_tensorboard_gets_every_number_of_the_log_once(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with pytest.raises(KeyboardInterrupt):
        run_training(Walk(stop_at=18), config(tensorboard=True, checkpoint_seconds=math.inf), tmp_path, key="k")
    run_training(Walk(), config(tensorboard=True), tmp_path, key="k")
    events = EventAccumulator(str(tmp_path / module.TENSORBOARD_FOLDER))
    events.Reload()
    logged = {"step/loss": ("step", "loss"), "evaluation/mean/psnr": ("evaluation", "mean")}
    assert {*logged, "step/seconds"} <= set(events.Tags()["scalars"])
    entries = read_metrics(tmp_path / "metrics.jsonl")
    for tag, (kind, name) in logged.items():
        told = [(e["iteration"], e[name]["psnr"] if name == "mean" else e[name]) for e in entries if e["kind"] == kind]
        assert [e.step for e in events.Scalars(tag)] == [step for step, _ in told]
        assert [e.value for e in events.Scalars(tag)] == pytest.approx([value for _, value in told], rel=1e-6)


def test_metrics_survive_a_line_that_was_cut_short(tmp_path):
    path = tmp_path / "metrics.jsonl"
    for k in range(4):
        append_metrics(path, {"kind": "step", "iteration": k, "loss": math.nan if k == 1 else 0.5})
    path.write_text(path.read_text() + '{"iteration": 4, "lo')
    assert [e["iteration"] for e in read_metrics(path)] == [0, 1, 2, 3]
    assert read_metrics(path)[1]["loss"] is None
    truncate_metrics(path, 2)
    assert [json.loads(line)["iteration"] for line in path.read_text().splitlines()] == [0, 1, 2]
    assert read_metrics(tmp_path / "none") == []


def test_lines_of_another_kind_are_left_out_and_told(tmp_path, caplog):
    path = tmp_path / "metrics.jsonl"
    foreign = [b"[1]", b"7", b"null", b"{}", b'{"kind": 3, "iteration": 1}', b'{"kind": "step", "iteration": "one"}']
    foreign += [b"\xff\xfe", b"[" * 5000, b'{"kind": "step"}', b"9" * 6000]
    append_metrics(path, {"kind": "step", "iteration": 0})
    assert read_metrics(path) and not caplog.records
    path.write_bytes(path.read_bytes() + b"\n".join(foreign) + b"\n")
    append_metrics(path, {"kind": "step", "iteration": 1})
    assert [entry["iteration"] for entry in read_metrics(path)] == [0, 1]
    assert f"{len(foreign)} lines" in caplog.text and "first is 2" in caplog.text
    truncate_metrics(path, 0)
    assert path.read_text().count("\n") == 1


def test_a_log_that_is_no_file_is_told_and_empty(tmp_path, caplog):
    os.mkfifo(tmp_path / "metrics.jsonl")
    for path in (tmp_path / "metrics.jsonl", "/dev/zero", tmp_path):
        caplog.clear()
        assert read_metrics(path) == [] and "regular file" in caplog.text


def test_a_training_that_stopped_before_its_first_step_logs_the_start_once(tmp_path):
    run_training(Walk(), config(max_seconds=0.0), tmp_path, key="k")
    run_training(Walk(), config(), tmp_path, key="k")
    run_training(Walk(), config(), tmp_path / "whole", key="k")
    logs = [read_metrics(folder / "metrics.jsonl") for folder in (tmp_path, tmp_path / "whole")]
    assert without_times(logs[0]) == without_times(logs[1])
