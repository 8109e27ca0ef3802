"""The same chains on Ray and through Slurm, and after kills: nothing is lost, nothing runs twice to its end."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.batch import clusters
from pipelines.batch.clusters import RayExecutor, RequeuedJob, SlurmExecutor
from pipelines.batch.driver import begin_batch, drive, take_batch
from pipelines.batch.executors import Task
from pipelines.batch.hold import JOB_HOLD, Hold, read_holder
from pipelines.batch.jobs import Job, read_jobs
from pipelines.batch.records import read_batch, read_job, records_of
from pipelines.batch.run_job import Resources
from pipelines.batch.steps import Needs
from smplxpp import InputError

STAND_IN = (sys.executable, str(Path(__file__).with_name("stand_in.py")))
STEPS = ("check", "build", "export")
DRIVER = """
import sys
from pathlib import Path
from pipelines.batch import driver
from pipelines.batch.executors import LocalExecutor
from pipelines.batch.jobs import read_jobs
from pipelines.batch.run_job import Resources
driver.current_key = lambda: "a" * 64
file = read_jobs(Path(sys.argv[1]))
with driver.take_batch(file.out) as held:
    _, jobs = driver.begin_batch(file, Path(sys.argv[1]))
    resources = Resources(program=tuple(sys.argv[2:]), folder=str(file.folder), max_retries=20)
    driver.drive(file.out, jobs, LocalExecutor(file.out, resources, workers=2, gpus=[], cores=2), held=held)
"""


@pytest.fixture(autouse=True)
def one_key(monkeypatch):
    monkeypatch.setattr("pipelines.batch.driver.current_key", lambda: "a" * 64)


def job_file(folder: Path, count: int, seconds: float) -> Path:
    (folder / "capture").mkdir()
    lines = [f"  - {{subject: s{k:02}, capture: capture}}" for k in range(count)]
    wait = f"{{seconds: {seconds}}}"
    defaults = f"defaults: {{steps: [check, build, export], check: {wait}, build: {wait}, export: {wait}}}"
    path = folder / "jobs.yaml"
    path.write_text("\n".join(["out: runs", defaults, "jobs:", *lines]))
    return path


def all_ran_once(runs: Path) -> None:
    """Every subject is done, and each of its steps came to its end once."""
    records = records_of(runs, read_batch(runs))
    assert {record.state for record in records} == {"done"}, [
        (record.subject, [(step.step, step.state, step.error) for step in record.steps])
        for record in records
        if record.state != "done"
    ]
    for record in records:
        assert (runs / record.subject / "ends.txt").read_text().split() == list(STEPS)


def run(path: Path, executor) -> object:
    file = read_jobs(path)
    with take_batch(file.out) as held:
        _, jobs = begin_batch(file, path)
        return drive(file.out, jobs, executor, held=held)


@pytest.mark.slow
def test_a_driver_that_is_killed_leaves_no_command_behind_and_a_second_goes_on(tmp_path):
    path = job_file(tmp_path, 6, 0.4)
    command = [sys.executable, "-c", DRIVER, str(path), *STAND_IN]
    chance = random.Random(0)
    for _ in range(3):
        driver = subprocess.Popen(command)
        until = time.monotonic() + 900
        seen = chance.randrange(1, 6)
        while len(list(tmp_path.glob("runs/*/*.tries"))) < seen and driver.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(chance.random())
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    assert subprocess.run(command, timeout=900, check=False).returncode == 0
    all_ran_once(tmp_path / "runs")


@pytest.mark.slow
def test_ten_random_kills_of_commands_cost_ten_attempts(tmp_path):
    path = job_file(tmp_path, 6, 0.5)
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, str(path), *STAND_IN])
    chance, killed, until = random.Random(1), 0, time.monotonic() + 1800
    while killed < 10 and driver.poll() is None and time.monotonic() < until:
        time.sleep(0.1 + 0.3 * chance.random())
        found = [read_job(tmp_path / "runs", folder.name) for folder in tmp_path.glob("runs/s*")]
        working = [s.pid for record in found if record for s in record.steps if s.state == "running" and s.pid]
        if working:
            try:
                os.killpg(chance.choice(working), signal.SIGKILL)
                killed += 1
            except ProcessLookupError:
                continue
    assert driver.wait(timeout=900) == 0
    all_ran_once(tmp_path / "runs")
    records = records_of(tmp_path / "runs", read_batch(tmp_path / "runs"))
    # A kill may come between the command's end and the record of it, and then costs nothing.
    assert 18 + 5 <= sum(step.attempts for record in records for step in record.steps) <= 18 + killed


@pytest.mark.slow
def test_a_ray_cluster_that_loses_a_node_loses_nothing(tmp_path):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    path = job_file(tmp_path, 8, 0.5)
    with _quiet():
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        node = cluster.add_node(num_cpus=2)
        try:
            resources = Resources(program=STAND_IN, folder=str(tmp_path), max_retries=3)
            executor = RayExecutor(tmp_path / "runs", resources, address=cluster.address)
            lost = []

            def report(progress) -> None:
                # In the middle: some are done, and others run.
                if not lost and progress.states["done"] >= 2:
                    lost.append(True)
                    cluster.remove_node(node, allow_graceful=False)

            file = read_jobs(path)
            with take_batch(file.out) as held:
                _, jobs = begin_batch(file, path)
                drive(file.out, jobs, executor, report=report, held=held)
            assert lost
        finally:
            ray.shutdown()
            cluster.shutdown()
    all_ran_once(tmp_path / "runs")


def test_ray_that_does_not_answer_is_told(tmp_path):
    pytest.importorskip("ray")
    with pytest.raises(InputError, match="ray start --head"):
        RayExecutor(tmp_path, Resources(), address="127.0.0.1:1")


def test_extras_that_are_not_installed_are_told(tmp_path, monkeypatch):
    for name in ("ray", "submitit"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"a batch on Ray needs ray.*extra cluster"):
        RayExecutor(tmp_path, Resources(), address="auto")
    with pytest.raises(ImportError, match=r"a batch on Slurm needs submitit.*extra cluster"):
        SlurmExecutor(tmp_path, Resources())


def test_a_ray_of_another_version_is_told(tmp_path, monkeypatch):
    """A cluster's own words, in the place of Ray, which the test environment lacks."""
    words = "Version mismatch: The cluster was started with: Ray: 2.9.0 Python: 3.10.4"

    def init(**options):
        raise RuntimeError(words)

    ray = SimpleNamespace(__version__="2.60.0", is_initialized=lambda: False, init=init)
    monkeypatch.setattr(clusters, "_ray", lambda: ray)
    with pytest.raises(InputError, match=r"Ray 2\.60\.0 and Python") as caught:
        RayExecutor(tmp_path, Resources(), address="auto")
    assert caught.value.received == words and "install its version" in caught.value.remedy


@pytest.mark.slow
def test_slurm_arrays_run_the_same_chains_by_submitits_own_stand_in(tmp_path):
    pytest.importorskip("submitit")
    path = job_file(tmp_path, 3, 0.0)
    resources = Resources(program=STAND_IN, folder=str(tmp_path))
    with _quiet():
        progress = run(path, SlurmExecutor(tmp_path / "runs", resources, cluster="local"))
    assert progress.states["done"] == 3
    all_ran_once(tmp_path / "runs")


def test_what_slurm_takes_back_goes_on_in_the_next_array(tmp_path):
    submitit = pytest.importorskip("submitit")
    path = job_file(tmp_path, 1, 0.0)
    job, resources = read_jobs(path).jobs[0], Resources(program=STAND_IN, folder=str(tmp_path))
    before = signal.getsignal(signal.SIGTERM)
    try:
        again = RequeuedJob().checkpoint(job, tmp_path / "runs/s00", resources)
        assert isinstance(again, submitit.helpers.DelayedSubmission)
        assert again.function(*again.args)["state"] == "done" and not read_holder(tmp_path / f"runs/s00/{JOB_HOLD}")
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.long
def test_a_worker_that_slurm_ends_costs_its_step_no_attempt(tmp_path):
    """A subject that was preempted three times failed, as if its machine had been lost so often."""
    path = job_file(tmp_path, 1, 600.0)
    words = f"""
from pathlib import Path
from pipelines.batch.clusters import RequeuedJob
from pipelines.batch.jobs import read_jobs
from pipelines.batch.run_job import Resources
resources = Resources(program={STAND_IN!r}, folder={str(tmp_path)!r})
RequeuedJob()(read_jobs(Path({str(path)!r})).jobs[0], Path({str(tmp_path / "runs/s00")!r}), resources)
"""
    worker = subprocess.Popen([sys.executable, "-c", words])
    until = time.monotonic() + 900
    while not (tmp_path / "runs/s00/check.tries").exists() and worker.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(timeout=900) == 128 + signal.SIGTERM
    step = read_job(tmp_path / "runs", "s00").step("check")
    assert (step.state, step.attempts, step.failures) == ("waiting", 1, 0)
    assert not read_holder(tmp_path / f"runs/s00/{JOB_HOLD}")


class Queue:
    """Commands that stand for Slurm's: `sbatch` numbers arrays, `squeue` prints a file, `scancel` empties it."""

    def __init__(self, folder: Path, monkeypatch) -> None:
        self.folder = folder
        folder.mkdir()
        (folder / "queue").touch()
        scripts = {
            "srun": "",
            "sbatch": "if [ -f refuse ]; then cat refuse >&2; exit 1; fi; echo x >> sent; n=$(wc -l < sent); "
            'grep -h "array=" "$1" >> arrays; echo "Submitted batch job $n"',
            "squeue": "cat queue",
            "scancel": 'echo "$@" >> cancelled; : > queue',
            "sinfo": "cat nodes 2>/dev/null",
        }
        for name, words in scripts.items():
            (folder / name).write_text(f"#!/bin/sh\ncd {folder}\n{words}\n")
            (folder / name).chmod(0o755)
        monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")

    def holds(self, *numbers: str) -> None:
        (self.folder / "queue").write_text("\n".join(numbers))


def test_slurm_without_accounting_loses_no_task_that_leaves_its_queue(tmp_path, monkeypatch):
    """`sacct` fails on a cluster without a database, and the driver waited for ever for a task that was cancelled."""
    submitit = pytest.importorskip("submitit")
    queue, runs = Queue(tmp_path / "bin", monkeypatch), tmp_path / "runs"
    executor = SlurmExecutor(runs, Resources(), every=0.0)
    tasks = [Task.of(Job(name, "capture", ("check",)), (("check",),)) for name in ("anna", "ben", "carl")]
    queue.holds("1_0", "1_1", "1_2")
    for task in tasks:
        executor.submit(task)
    assert executor.ended(0.0) == []
    # Anna's answer is there; ben is gone, which counts when he is absent a second time; carl still waits.
    answer = runs / "cluster/1/1_0_0_result.pkl"
    submitit.core.utils.cloudpickle_dump(("success", {"subject": "anna", "meaning": "done"}), answer)
    queue.holds("1_2")
    assert executor.ended(0.0) == [(tasks[0], {"subject": "anna", "meaning": "done"})]
    [(lost, error)] = executor.ended(0.0)
    assert lost is tasks[1] and "left Slurm's queue without an answer" in str(error)
    assert executor.ended(0.0) == []
    # A stop takes back what waits in the queue, by the name of this batch alone.
    assert executor.withdraw() == [tasks[2]]
    assert f"--name={clusters._name(runs)} --state=PENDING" in (tmp_path / "bin/cancelled").read_text()
    # What a worker of an earlier driver holds is not sent a second time.
    (runs / "anna").mkdir()
    with Hold(runs / "anna" / JOB_HOLD, subject="anna"):
        assert not executor.room(tasks[0]) and executor.room(tasks[1])


def test_gpus_of_a_partition_that_has_none_are_refused_before_the_work(tmp_path, monkeypatch):
    """Slurm refused the training an hour later, when the build was done, and waited for others to end."""
    pytest.importorskip("submitit")
    queue = Queue(tmp_path / "bin", monkeypatch)
    nodes, job = queue.folder / "nodes", Job("anna", "capture", ("build", "train"))
    nodes.write_text("main* (null)\ngpu gpu:h100:8(S:0-1)\n")
    with pytest.raises(InputError, match=r"partition without GPUs \(the default one\).*gpus: 0"):
        SlurmExecutor(tmp_path / "runs", Resources()).check(job)
    SlurmExecutor(tmp_path / "runs", Resources()).check(Job("anna", "capture", ("build",)))
    SlurmExecutor(tmp_path / "runs", Resources()).check(replace(job, needs=Needs(gpus=0.0)))
    # Nodes that have GPUs, and a Slurm that says nothing.
    for words in ("main* gpu:2\n", "main* (null)\nmain* gpu:a100:4\n", ""):
        nodes.write_text(words)
        SlurmExecutor(tmp_path / "runs", Resources()).check(job)


def test_more_tasks_than_an_array_may_have_become_two(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    Queue(tmp_path / "bin", monkeypatch)
    executor = SlurmExecutor(tmp_path / "runs", Resources())
    sent = []
    monkeypatch.setattr(executor, "_send", lambda tasks: sent.append(len(tasks)))
    for k in range(1500):
        executor.submit(Task.of(Job(f"s{k}", "capture", ("check",)), (("check",),)))
    executor.ended(0.0)
    executor.ended(0.0)
    assert sent == [1000, 500]


def test_what_slurm_refuses_is_told_in_its_words(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    queue = Queue(tmp_path / "bin", monkeypatch)
    executor = SlurmExecutor(tmp_path / "runs", Resources(), partition="nope")
    executor.submit(Task.of(Job("anna", "capture", ("check",)), (("check",),)))
    # A controller that does not answer for a moment is asked again.
    refuse = queue.folder / "refuse"
    refuse.write_text("sbatch: error: Unable to contact slurm controller (connect failure)")
    assert executor.ended(0.0) == [] and executor.ended(0.0) == []
    refuse.write_text("sbatch: error: invalid partition specified: nope")
    executor._again = 0.0
    with pytest.raises(InputError, match=r"invalid partition specified: nope.*SBATCH_ACCOUNT"):
        executor.ended(0.0)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="login node"):
        SlurmExecutor(tmp_path / "runs", Resources())


def slurm_answers() -> bool:
    """Return whether a Slurm with a free node is here (`sh tools/try_slurm.sh FOLDER` starts one)."""
    if not shutil.which("sbatch"):
        return False
    done = subprocess.run(["sinfo", "--noheader", "--states=idle,mix,alloc"], capture_output=True, check=False)
    return done.returncode == 0 and bool(done.stdout)


@pytest.mark.slow
@pytest.mark.skipif(not slurm_answers(), reason="no Slurm")
def test_a_slurm_that_cancels_and_requeues_loses_nothing(tmp_path):
    pytest.importorskip("submitit")
    path, done = job_file(tmp_path, 4, 2.0), []
    name = clusters._name(tmp_path / "runs")

    def report(progress) -> None:
        words = ["squeue", f"--name={name}", "--array", "--noheader", "--format=%i", "--states=RUNNING"]
        running = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
        tries = [f for f in tmp_path.glob("runs/*/check.tries")]
        if not done and running and tries:
            subprocess.run(["scancel", running[0]], check=True)
            done.append("cancelled")
        elif len(done) == 1 and len(running) > 1:
            subprocess.run(["scontrol", "requeue", running[-1]], check=True)
            done.append("requeued")

    file = read_jobs(path)
    resources = Resources(program=STAND_IN, folder=str(tmp_path))
    with _quiet(), take_batch(file.out) as held:
        _, jobs = begin_batch(file, path)
        executor = SlurmExecutor(file.out, resources, minutes=10, every=2.0)
        drive(file.out, jobs, executor, report=report, held=held)
    assert done[:1] == ["cancelled"]
    all_ran_once(tmp_path / "runs")
    records = records_of(file.out, read_batch(file.out))
    assert sum(step.failures for record in records for step in record.steps) == 0


class _quiet:
    """Warnings of packages that are not ours are no errors here."""

    def __enter__(self):
        import warnings

        self.caught = warnings.catch_warnings()
        self.caught.__enter__()
        warnings.simplefilter("ignore")

    def __exit__(self, *error):
        self.caught.__exit__(*error)
