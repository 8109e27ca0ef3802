"""Two real processes (gloo) train as one does, agree to the bit, and stop together."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from avatar.training.engine.adam import OptimiserConfig
from avatar.training.engine.checkpoints import STATE_FILE
from avatar.training.engine.loop import METRICS_FILE, LoopConfig, run_training
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.engine.processes import Distributed, join_processes
from smplxpp.core.errors import InputError
from tests.dolls.toy import Toy, same_state

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = Path(__file__).with_name("two_processes.py")
TIMES = ("seconds", "iterations_per_second")


def start(folder: Path, *launcher: str) -> None:
    """Let two processes train in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *launcher, str(SCRIPT), str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> Path:
    """The folder that two processes left."""
    folder = tmp_path_factory.mktemp("both")
    start(folder)
    return folder


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> tuple[Toy, Path]:
    """The same training by one process."""
    folder = tmp_path_factory.mktemp("alone")
    task = Toy(OptimiserConfig(iterations=20))
    run_training(task, LoopConfig(iterations=20, log_every=5, evaluate_every=10), folder, key="k")
    return task, folder


def test_two_processes_find_what_one_finds(both, alone):
    found, wanted = load_file(both / "whole_0.safetensors"), alone[0].state()
    assert found.keys() == wanted.keys()  # moments of what had a gradient on one process alone, none of `unused`
    for name, value in wanted.items():
        torch.testing.assert_close(
            found[name], value.detach(), rtol=0, atol=1e-6, msg=lambda text, n=name: f"{n} {text}"
        )


def test_both_processes_hold_the_same_bits_though_they_began_apart(both):
    one, two = (load_file(both / f"whole_{rank}.safetensors") for rank in (0, 1))
    assert same_state(one, two)


def test_the_log_is_written_once_with_means_over_all_items(both, alone):
    found, wanted = (read_metrics(folder / METRICS_FILE) for folder in (both / "whole", alone[1]))
    assert len(found) == len(wanted) == 4 + 3
    for one, two in zip(found, wanted, strict=True):
        assert one.keys() == two.keys() and one["iteration"] == two["iteration"]
        for name in ("loss", "odd_loss"):
            assert one.get(name) == pytest.approx(two.get(name), abs=1e-6)
        assert one.get("items") == two.get("items")


def test_a_limit_of_time_is_the_first_processes_and_the_rest_is_the_same_to_the_bit(both):
    assert same_state(load_file(both / "whole_1.safetensors"), load_file(both / "parts_1.safetensors"))
    assert same_state(load_file(both / "parts_0.safetensors"), load_file(both / "parts_1.safetensors"))


@pytest.mark.parametrize(
    ("what", "words"),
    [
        # Steps 7 and 8 are left out; item 0 of step 9 is found by process 0.
        ("diverged", "DivergedError: training step 9, batch 27: "),
        ("few", "expected at least one for each of 2 processes, received 1"),
        ("key", "received one of others, at iteration 1"),
    ],
)
def test_all_processes_stop_with_the_same_words(both, what, words):
    messages = [json.loads((both / f"report_{rank}.json").read_text())[what] for rank in (0, 1)]
    assert messages[0] == messages[1].removeprefix("Told")  # the first process tells it
    assert words in messages[0]


def test_messages_arrive_as_they_were_sent_without_pickles(both):
    one, two = (json.loads((both / f"report_{rank}.json").read_text())["messages"] for rank in (0, 1))
    assert one["sent"] and two["sent"] and one["shared"] and two["shared"]
    assert one["unknown"] == "TypeError: processes do not send each other a set" and "a set" in two["unknown"]


def test_what_all_processes_open_is_equal_or_refused_by_all(both):
    one, two = (json.loads((both / f"report_{rank}.json").read_text())["messages"] for rank in (0, 1))
    assert (one["own"], two["own"]) == (0, 1)
    assert (one["warned"], two["warned"]) == (1, 0)  # a warning comes once
    assert "Told" + one["apart"] == two["apart"] and "other contents on rank 1" in one["apart"]
    assert one["broken"].startswith("InputError: process 1: ") and "OSError: [Errno 5]" in one["broken"]
    assert two["broken"].startswith("OSError")


def test_a_disk_that_is_full_for_the_first_process_stops_the_second(both):
    messages = [json.loads((both / f"report_{rank}.json").read_text())["disk"] for rank in (0, 1)]
    assert "free some space" in messages[0].lower()
    assert "No space left on device" in messages[1]


def test_a_checkpoint_of_two_processes_is_one_for_one(both, alone, tmp_path):
    (tmp_path / STATE_FILE).write_bytes((both / "other" / STATE_FILE).read_bytes())
    task = Toy(OptimiserConfig(iterations=20), seed=9)
    run_training(task, LoopConfig(iterations=20), tmp_path, key="k")
    for name, value in alone[0].state().items():
        torch.testing.assert_close(task.state()[name], value, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_torchrun_starts_them_as_well(both, tmp_path):
    start(tmp_path, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    for rank in (0, 1):
        name = f"whole_{rank}.safetensors"
        assert same_state(load_file(tmp_path / name), load_file(both / name))


def test_one_process_needs_no_environment(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with join_processes() as together:
        assert together == Distributed() and together.first
        assert together.share_out([3, 4, 5], lambda item: 2 * item) == [6, 8, 10]
        assert not torch.distributed.is_initialized()


def test_what_comes_after_a_failure_is_left_out():
    seen = []
    assert Distributed().share_out([1, 2, 3], lambda item: seen.append(item)) == [None] * 3
    assert seen == [1]


@pytest.mark.parametrize("missing", ["RANK", "LOCAL_RANK"])
def test_an_environment_that_torchrun_does_not_make_is_refused(monkeypatch, missing):
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"):
        monkeypatch.setenv(name, "0" if name != missing else "zero")
    with pytest.raises(InputError, match=f"environment variable {missing}.*torchrun"), join_processes():
        pass


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
def test_more_processes_than_gpus_are_refused(monkeypatch):
    for name, value in (("RANK", "1"), ("LOCAL_RANK", "1"), ("WORLD_SIZE", "2")):
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match="one for each of 0 GPUs"), join_processes("cuda"):
        pass
