"""Real trainings as jobs: a refinement in chunks of frames, and one subject on two processes."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from pipelines.batch import process
from pipelines.batch.jobs import Job
from pipelines.batch.records import read_job
from pipelines.batch.run_job import Resources, run_job
from pipelines.batch.steps import Needs
from pipelines.cli import main
from pipelines.commands.batch import check_options
from smplxpp.body import load_params
from smplxpp.core import InputError
from tests.dolls.gesturing import disturbed, doll, gestures, write_gestures


def test_a_chain_asks_for_a_refinement_in_chunks_that_its_training_takes(tmp_path):
    options = {"train": {"preset": "demo", "seed": 3, "refine_cameras": True, "device": "cpu"}}
    job = Job("anna", "cap", ("register", "build", "refine", "train"), options, frames=100)
    check_options((job,))
    words = job.command("refine", tmp_path, "cap")
    assert words[:6] == ["batch", "frames", "refine", str(tmp_path / "refine"), "--capture", "cap"]
    assert words[words.index("--into") + 1] == str(tmp_path / "run")
    # What decides the refinement is the training's, and nothing else of it.
    also = words[words.index("--also") + 1 : -1]
    assert also == ["seed=3", "refine_cameras", f"params={tmp_path / 'register' / 'params.npz'}"]
    train = job.command("train", tmp_path, "cap")
    assert train[train.index("--refine-frames") + 1] == "100"
    assert train[train.index("--params") + 1] == str(tmp_path / "register" / "params.npz")
    whole = replace(job, frames=0).command("refine", tmp_path, "cap")
    assert whole[:6] == ["train", str(tmp_path / "run"), "--capture", "cap", "--stage", "refine"]
    assert "--refine-frames" not in replace(job, frames=0).command("train", tmp_path, "cap")


def test_chunks_of_a_refinement_need_the_run_that_they_go_into(tmp_path, capsys):
    words = ["batch", "frames", "refine", str(tmp_path / "out"), "--capture", str(tmp_path), "--json"]
    assert main(words) == 2 and "--into RUN" in json.loads(capsys.readouterr().out)["error"]["expected"]
    with pytest.raises(InputError, match="no such option"):
        check_options((Job("a", "cap", ("refine",), {"refine": {"size": 3}}),))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    root = write_gestures(tmp_path_factory.mktemp("captures") / "gestures")
    disturbed(gestures()).save(root / "params" / "params_noisy.npz")
    return root


@pytest.mark.slow
def test_a_take_refined_in_chunks_is_what_one_process_makes_of_it(capture, tmp_path, capsys):
    noisy, made = str(capture / "params/params_noisy.npz"), []
    run, alone = (doll().write_run(tmp_path / name) for name in ("run", "alone"))
    words = ["batch", "frames", "refine", str(tmp_path / "out"), "--capture", str(capture), "--into", str(run)]
    words += ["--size", "3", "--local", "2", "--json", "--also", f"params={noisy}", "refine_poses=on", "device=cpu"]
    for _ in range(2):  # the second finds everything done
        assert main(words) == 0
        answer = json.loads(capsys.readouterr().out)
        assert answer["frames"] == 5
        made.append((run / "66_refine/manifest.json").stat().st_mtime_ns)
    assert made[0] == made[1]
    one = ["train", str(alone), "--capture", str(capture), "--params", noisy, "--stage", "refine", "--refine-frames"]
    assert main([*one, "3", "--refine-poses", "on", "--device", "cpu", "--json", "--no-report"]) == 0
    in_chunks, whole = (load_params(folder / "66_refine/params.npz") for folder in (run, alone))
    for name, array in in_chunks.as_dict().items():
        np.testing.assert_array_equal(array, whole.as_dict()[name])


@pytest.mark.slow
def test_a_job_with_two_gpus_trains_one_subject_on_two_processes_that_share_the_chunks(capture, tmp_path):
    """On a CPU: the job's devices are only names, and gloo carries the messages."""
    folder = tmp_path / "runs" / "anna"
    doll().write_run(folder / "run")
    train = {
        **{"preset": "demo", "params": str(capture / "params/params_noisy.npz"), "refine_poses": "on"},
        **{"refine_frames": 3, "iterations_share": 0.002, "gaussians": 400, "device": "cpu", "no_report": True},
    }
    job = Job("anna", str(capture), ("train",), {"train": train}, needs=Needs(gpus=2.0), accept=("train",))
    answer = run_job(job, folder, Resources(threads=1, gpus="0,1", max_retries=0))
    log = (folder / "logs/train.log").read_text()
    assert answer["state"] == "done", log[-3000:]
    stages = json.loads((folder / "logs/train.json").read_text())["stages"]
    assert list(stages) == ["refine", "fit", "teacher", "bake", "compensate"] or "cloth" in stages
    assert read_job(tmp_path / "runs", "anna").state == "done"


def ranks(text: str, folder, *, captured: bool = True):
    """Two processes that leave their numbers in a folder and run a text with their `rank`."""
    begin = "import os, sys, time; from pathlib import Path; rank = os.environ['RANK']; "
    begin += "Path(sys.argv[1], rank).write_text(str(os.getpid())); "
    words = [sys.executable, "-S", "-E", "-c", begin + "\n" + text, str(folder)]
    return process.run_together(words, 2, captured=captured)


def none_left(folder) -> bool:
    for path in folder.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)
    return True


def test_a_process_that_is_killed_ends_the_other_and_is_named(tmp_path):
    # Who is not ended sleeps for an hour, so that no clock has to tell.
    text = "os.kill(os.getpid(), 9) if rank == '1' else time.sleep(3600)"
    with pytest.raises(ChildProcessError, match="process 1 of 2: expected to run to its end, received SIGKILL"):
        ranks(text, tmp_path)
    assert none_left(tmp_path)


def test_processes_that_fail_by_themselves_leave_their_words(tmp_path, caplog):
    text = "print('answer ' + rank); time.sleep(0.1 * (rank == '0')); sys.exit(2 if rank == '0' else 'no disk')"
    assert ranks(text, tmp_path) == (2, "answer 0\n")
    assert "process 1 of 2: no disk" in caplog.text


def test_an_interrupt_ends_all_processes(tmp_path, monkeypatch):
    sleep = time.sleep

    def interrupted(seconds: float) -> None:
        sleep(0.01)
        if len([path for path in tmp_path.iterdir() if path.read_text()]) == 2:
            monkeypatch.undo()
            raise KeyboardInterrupt

    monkeypatch.setattr(process.time, "sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ranks("time.sleep(3600)", tmp_path)
    assert none_left(tmp_path)
