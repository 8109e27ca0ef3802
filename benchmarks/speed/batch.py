"""Time the runner of many subjects: its overhead a job, a thousand empty jobs, one worker against two, kills.

    python -m benchmarks batch [--jobs 1000] [--kills 10]

The commands are stand-ins that answer at once or sleep, so that what is measured is the runner's own.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.support.results import store_results
from pipelines.batch.driver import Progress, begin_batch, drive, take_batch
from pipelines.batch.executors import LocalExecutor
from pipelines.batch.jobs import read_jobs
from pipelines.batch.records import JobRecord, read_batch, read_job, records_of
from pipelines.batch.run_job import Resources


@dataclass(frozen=True)
class BatchBenchmark:
    """Time `smplxpp batch` on stand-ins of its commands."""

    jobs: int = 1000
    """Empty jobs of one step."""
    kills: int = 10
    """Random kills of running commands."""

    def run(self) -> None:
        """Measure, print and store."""
        before = resource.getrusage(resource.RUSAGE_SELF)
        figures: dict[str, Any] = {"empty": _row(*_run(self.jobs, ("check",), workers=2))}
        after = resource.getrusage(resource.RUSAGE_SELF)
        own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        figures["empty"] |= {"driver_cpu_ms_a_job": 1e3 * own / self.jobs, "driver_peak_mb": 1.024e-3 * after.ru_maxrss}
        for workers in (1, 2):
            done = _run(12, ("check", "build", "export"), workers=workers, seconds=1.0)
            figures[f"sleeping, {workers} workers"] = _row(*done)
        figures["kills"] = _killed(self.kills)
        figures["interpreter_cpu_seconds"] = _interpreter()
        for name, row in figures.items():
            print(name, row)
        store_results("batch", "python -m benchmarks batch", figures)


def _run(
    count: int,
    steps: tuple[str, ...],
    *,
    workers: int,
    seconds: float = 0.0,
    report: Callable[[Path, Progress], None] = lambda runs, progress: None,
) -> tuple[float, list[JobRecord]]:
    """Run empty jobs; the seconds that it took, and their records."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "capture").mkdir()
        lines = [f"  - {{subject: s{k:04}, capture: capture}}" for k in range(count)]
        path = folder / "jobs.yaml"
        path.write_text("\n".join(["out: runs", f"defaults: {{steps: [{', '.join(steps)}]}}", "jobs:", *lines]))
        file = read_jobs(path)
        program = ("/bin/sh", "-c", f"sleep {seconds}; echo '{{\"finished\": true}}'", "sh")
        resources = Resources(program=program, folder=place, max_retries=100)
        with take_batch(file.out) as held:
            begin_batch(file, path)
            begin = time.perf_counter()
            executor = LocalExecutor(file.out, resources, workers=workers, gpus=[], cores=2)
            drive(file.out, file.jobs, executor, held=held, report=lambda progress: report(file.out, progress))
            took = time.perf_counter() - begin
        return took, records_of(file.out, read_batch(file.out))


def _row(took: float, records: list[JobRecord]) -> dict[str, Any]:
    """Return the time a job beside the sum of its commands."""
    commands = sum(step.seconds for record in records for step in record.steps)
    states = [record.state for record in records]
    return {
        "jobs": len(records),
        "done": states.count("done"),
        "seconds": took,
        "commands_seconds": commands,
        "ms_a_job": 1e3 * took / len(records),
    }


def _killed(kills: int) -> dict[str, Any]:
    """Return what random kills of running commands cost."""
    chance, ended = random.Random(0), []

    def kill(runs: Path, progress: Progress) -> None:
        found = [read_job(runs, subject) for subject in progress.running]
        at_work = [s.pid for record in found if record for s in record.steps if s.state == "running" and s.pid]
        if at_work and len(ended) < kills:
            try:
                os.killpg(chance.choice(at_work), signal.SIGKILL)
                ended.append(True)
            except ProcessLookupError:
                pass

    took, records = _run(8, ("check", "build", "export"), workers=2, seconds=2.0, report=kill)
    attempts = sum(step.attempts for record in records for step in record.steps)
    return {**_row(took, records), "kills": len(ended), "attempts": attempts, "steps": 3 * len(records)}


def _interpreter() -> float:
    """Return the CPU seconds of a command that does nothing: Python's start and our imports."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "pipelines.cli", "--version"], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    tyro.cli(BatchBenchmark, prog="python -m benchmarks batch").run()
