"""A chain of commands a subject: what becomes of each kind of end, and what a second start runs."""

from __future__ import annotations

import errno
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.batch.driver import begin_batch, drive, retry, take_batch
from pipelines.batch.executors import LocalExecutor
from pipelines.batch.hold import request_stop
from pipelines.batch.jobs import read_jobs
from pipelines.batch.records import read_batch, read_job, records_of
from pipelines.batch.run_job import Resources, run_job
from smplxpp import InputError


@pytest.fixture(autouse=True)
def one_key(monkeypatch):
    """Digests of all sources take a second, which one test spends."""
    monkeypatch.setattr("pipelines.batch.driver.current_key", lambda: "a" * 64)


STAND_IN = (sys.executable, str(Path(__file__).with_name("stand_in.py")))


class Fleet:
    """A job file in a folder of its own, driven with commands that stand in for ours."""

    def __init__(self, folder: Path, jobs: dict[str, str], steps: str = "check, build") -> None:
        self.folder, self.path, self.runs = folder, folder / "jobs.yaml", folder / "runs"
        (folder / "capture").mkdir(exist_ok=True)
        self.write(jobs, steps)
        self.resources = Resources(program=STAND_IN, folder=str(folder), wait=0.5)

    def write(self, jobs: dict[str, str], steps: str = "check, build") -> None:
        lines = [f"  - {{subject: {name}, capture: capture{', ' * bool(more)}{more}}}" for name, more in jobs.items()]
        self.path.write_text("\n".join(["out: runs", f"defaults: {{steps: [{steps}]}}", "jobs:", *lines]))

    def start(self, *, workers: int = 2, gpus: tuple[str, ...] = (), upgrade: bool = False):
        file = read_jobs(self.path)
        with take_batch(file.out) as held:
            _, jobs = begin_batch(file, self.path, upgrade=upgrade)
            executor = LocalExecutor(file.out, self.resources, workers=workers, gpus=list(gpus), cores=4)
            return drive(file.out, jobs, executor, total=len(file.jobs), held=held)

    def states(self) -> dict[str, str]:
        return {record.subject: record.state for record in records_of(self.runs, read_batch(self.runs))}

    def step(self, subject: str, step: str):
        return read_job(self.runs, subject).step(step)

    def ends(self, subject: str) -> list[str]:
        return (self.runs / subject / "ends.txt").read_text().split()


@pytest.mark.long
def test_each_end_is_told_and_no_other_subject_is_touched(tmp_path):
    fleet = Fleet(
        tmp_path,
        {
            "good": "",
            "crash": "build: {do: crash}",
            "oom": "build: {do: kill}",
            "half": "build: {do: refuse}",
            "gates": "build: {do: gates}",
            "worn": "build: {do: kill, times: 9}",
            "accepted": "build: {do: gates}, accept: [build]",
        },
    )
    progress = fleet.start()
    assert fleet.states() == {
        **{"good": "done", "crash": "failed", "oom": "done", "half": "refused", "gates": "failed", "worn": "failed"},
        "accepted": "done",
    }
    assert progress.states["done"] == 3 and not progress.halted
    # Three sentences are kept as they are, and neither they nor gates nor our own mistakes are tried again.
    half = fleet.step("half", "build")
    assert half.error == {
        **{"type": "InputError", "subject": "scan", "expected": "a person", "received": "half of one"},
        **{"remedy": "scan again", "message": "scan: expected a person"},
    }
    assert (half.attempts, fleet.step("gates", "build").attempts, fleet.step("crash", "build").attempts) == (1, 1, 1)
    assert fleet.step("crash", "build").error == {"message": "RuntimeError: a face without corners"}
    assert fleet.step("gates", "build").error["checks"] == ["P2S"]
    # A killed command has no answer; it is given again, twice at most.
    assert (fleet.step("oom", "build").attempts, fleet.step("worn", "build").attempts) == (2, 3)
    assert fleet.step("worn", "build").exit_status == -9
    assert "SIGKILL" in fleet.step("worn", "build").error["message"]


def test_a_second_start_runs_what_does_not_stand_and_nothing_else(tmp_path):
    fleet = Fleet(tmp_path, {"anna": "", "ben": "build: {do: gates}"})
    fleet.start()
    before = [(tmp_path / f"runs/{name}/job.json").read_bytes() for name in ("anna", "ben")]
    fleet.start()
    assert [(tmp_path / f"runs/{name}/job.json").read_bytes() for name in ("anna", "ben")] == before
    # A manifest that is gone, an option that changed, and a failure that is put back make a subject run again.
    (fleet.runs / "anna/run/08_capture/manifest.json").unlink()
    fleet.start()
    assert fleet.ends("anna") == ["check", "build", "build"]
    assert fleet.step("anna", "check").attempts == 1
    assert retry(fleet.runs) == ["ben"]
    fleet.write({"anna": "check: {do: ok}", "ben": "build: {do: ok}"})
    fleet.start()
    assert fleet.states() == {"anna": "done", "ben": "done"}
    assert fleet.step("anna", "check").attempts == 2


def test_a_full_disk_halts_the_batch_and_fails_nobody(tmp_path):
    names = [f"s{number}" for number in range(6)]
    fleet = Fleet(tmp_path, {name: "build: {do: full}" if name == "s1" else "" for name in names})
    progress = fleet.start(workers=1)
    assert os.strerror(errno.ENOSPC) in progress.halted and "s1" in progress.halted
    assert fleet.states() == {"s0": "done", **dict.fromkeys(names[1:], "waiting")}
    fleet.write(dict.fromkeys(names, ""))
    fleet.start()
    assert set(fleet.states().values()) == {"done"} and fleet.step("s0", "build").attempts == 1


def test_a_training_at_its_limit_goes_on(tmp_path):
    fleet = Fleet(tmp_path, {"anna": "train: {do: again, times: 4}, resources: {minutes: 60}"}, "train, export")
    fleet.start()
    assert fleet.states() == {"anna": "done"} and fleet.step("anna", "train").attempts == 5
    answer = json.loads((fleet.runs / "anna/logs/train.json").read_text())
    minutes = float(answer["words"][answer["words"].index("--max-minutes") + 1])
    assert 50 < minutes < 60  # what writes the last models has to end within the limit, too


def test_a_stop_ends_running_commands_and_a_start_goes_on(tmp_path):
    fleet = Fleet(tmp_path, {"anna": "build: {do: hang}", "ben": ""})
    job = read_jobs(fleet.path).jobs[0]
    fleet.runs.mkdir()
    request_stop(fleet.runs)
    assert run_job(job, fleet.runs / "anna", fleet.resources)["meaning"] == "stopped"
    assert read_job(fleet.runs, "anna").state == "stopped" and not fleet.step("anna", "check").attempts
    # A stop that comes while a command runs.
    (fleet.runs / "stop.json").unlink()
    file = read_jobs(fleet.path)
    with take_batch(file.out):
        _, jobs = begin_batch(file, fleet.path)
        executor = LocalExecutor(file.out, fleet.resources, workers=1, gpus=[], cores=1)

        def report(progress):
            if (fleet.runs / "anna/build.tries").exists():
                request_stop(fleet.runs)

        progress = drive(file.out, jobs, executor, report=report)
    assert progress.halted == "a stop was asked for"
    assert fleet.states() == {"anna": "stopped", "ben": "waiting"}
    fleet.start()
    assert fleet.states() == {"anna": "done", "ben": "done"} and fleet.ends("anna") == ["check", "build"]


def test_gpus_are_shared_out_and_cpu_steps_see_none(tmp_path):
    fleet = Fleet(
        tmp_path,
        {"anna": "resources: {gpus: 0.5}", "ben": "resources: {gpus: 2, cores: 3}", "carl": "resources: {gpus: 0}"},
        "check, train",
    )
    fleet.start(workers=2, gpus=("4", "7"))
    seen = {}
    for name in ("anna", "ben", "carl"):
        for step in ("check", "train"):
            facts = json.loads((fleet.runs / name / f"logs/{step}.json").read_text())
            seen[name, step] = facts["CUDA_VISIBLE_DEVICES"], facts["OMP_NUM_THREADS"]
    assert seen["anna", "check"] == ("", "2") and seen["anna", "train"] in (("4", "2"), ("7", "2"))
    assert seen["ben", "train"] == ("4,7", "3") and seen["carl", "train"] == ("", "2")
    assert fleet.step("ben", "train").gpu == "4,7"
    fleet.write({"dora": "resources: {gpus: 3}"}, "train")
    with pytest.raises(InputError, match="at most 2"):
        fleet.start(gpus=("0", "1"))


def test_a_capture_that_is_not_there_is_refused_and_the_others_go_on(tmp_path):
    fleet = Fleet(tmp_path, {"anna": "", "ben": ""})
    fleet.path.write_text(
        fleet.path.read_text().replace("subject: ben, capture: capture", "subject: ben, capture: none")
    )
    fleet.start()
    assert fleet.states() == {"anna": "done", "ben": "refused"}
    error = fleet.step("ben", "check").error
    assert "does not exist" in error["received"] and error["remedy"].startswith("correct the job file")


def test_another_version_is_refused_unless_an_upgrade_is_asked_for(tmp_path, monkeypatch):
    fleet = Fleet(tmp_path, {"anna": ""})
    fleet.start()
    monkeypatch.setattr("pipelines.batch.driver.current_key", lambda: "f" * 64)
    with pytest.raises(InputError, match="upgrade"):
        fleet.start()
    assert fleet.step("anna", "build").attempts == 1
    fleet.start(upgrade=True)
    assert fleet.step("anna", "build").attempts == 2 and read_batch(fleet.runs).code_key == "f" * 64


def test_a_worker_with_other_code_does_no_work(tmp_path, monkeypatch):
    fleet = Fleet(tmp_path, {"anna": ""})
    fleet.resources = replace(fleet.resources, code_key="f" * 64)
    monkeypatch.setattr("pipelines.batch.run_job.current_key", lambda: "e" * 64)
    progress = fleet.start()
    assert "another version" in progress.halted and fleet.states() == {"anna": "waiting"}
    assert not fleet.step("anna", "check").attempts
