"""Where the calls of `run_job` run: what the driver asks of a place, and threads of this machine."""

from __future__ import annotations

import os
import subprocess
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from pipelines.batch.jobs import Job
from pipelines.batch.run_job import Resources, run_job
from pipelines.batch.steps import STEPS
from smplxpp.core.errors import InputError

Outcome = dict[str, Any] | BaseException


@dataclass(frozen=True)
class Task:
    """A part of a subject's chain whose steps take the same of a machine.

    Attributes:
        job: the subject.
        steps: of this part.
        rest: the parts behind it.
        on_gpu: whether it takes the GPUs that its job names.
    """

    job: Job
    steps: tuple[str, ...]
    rest: tuple[tuple[str, ...], ...] = ()
    on_gpu: bool = False

    @staticmethod
    def of(job: Job, parts: tuple[tuple[str, ...], ...]) -> Task:
        """Return the first of a chain's parts."""
        return Task(job, parts[0], parts[1:], on_gpu=bool(job.needs.gpus) and STEPS[parts[0][0]].on_gpu)


class Executor(Protocol):
    """What the driver asks of a place to run tasks."""

    splits: bool
    """Whether a chain is cut where it begins or ends to need a GPU."""

    def check(self, job: Job) -> None:
        """Raise `InputError` where a job asks for more than there is."""
        ...

    def room(self, task: Task) -> bool:
        """Return whether a task can begin, or be queued, now."""
        ...

    def submit(self, task: Task) -> None:
        """Begin a task, or queue it."""
        ...

    def ended(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Wait so long for tasks to end; return those that did, with what `run_job` returned or what lost them."""
        ...

    def withdraw(self) -> list[Task]:
        """Take back what is queued and has not begun; return it."""
        ...

    def close(self) -> None:
        """Give back what was taken."""
        ...


class LocalExecutor:
    """Threads of this machine, a subject each; cores and GPUs are shared out among them.

    Args:
        runs: RUNS.
        resources: of each task; threads and GPUs are this class's to set.
        workers: subjects at a time.
        gpus: names of the GPUs, as CUDA_VISIBLE_DEVICES has them.
        cores: of this machine.
    """

    def __init__(self, runs: Path, resources: Resources, *, workers: int, gpus: list[str], cores: int) -> None:
        self.runs, self.resources, self.workers = runs, resources, workers
        self.threads, self.splits = max(1, cores // workers), bool(gpus)
        self._free = dict.fromkeys(gpus, 1.0)
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="batch")
        self._running: dict[Future[dict[str, Any]], tuple[Task, dict[str, float]]] = {}

    def check(self, job: Job) -> None:
        """Refuse a job that asks for more GPUs than there are; where there are none, it trains on cores."""
        if self._free and job.needs.gpus > len(self._free):
            raise too_many_gpus(job, f"at most {len(self._free)}, which this machine has")

    def room(self, task: Task) -> bool:
        """Return whether a worker and the task's GPUs are free."""
        return len(self._running) < self.workers and self._shares(task) is not None

    def submit(self, task: Task) -> None:
        """Begin a task."""
        shares = self._shares(task) or {}
        for gpu, share in shares.items():
            self._free[gpu] -= share
        resources = replace(
            self.resources,
            steps=task.steps,
            threads=task.job.needs.cores or self.threads,
            gpus=",".join(shares),
            minutes=task.job.needs.minutes,
        )
        future = self._pool.submit(run_job, task.job, self.runs / task.job.subject, resources)
        self._running[future] = task, shares

    def ended(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Wait for tasks to end."""
        done, _ = wait(self._running, timeout=seconds, return_when=FIRST_COMPLETED)
        out: list[tuple[Task, Outcome]] = []
        for future in done:
            task, shares = self._running.pop(future)
            for gpu, share in shares.items():
                self._free[gpu] += share
            out.append((task, future.exception() or future.result()))
        return out

    def withdraw(self) -> list[Task]:
        """Return nothing: what is taken begins at once."""
        return []

    def close(self) -> None:
        """Wait for the threads."""
        self._pool.shutdown()

    def _shares(self, task: Task) -> dict[str, float] | None:
        """Return the shares of GPUs for a task, {} where it takes none; None where they are not free."""
        wanted = task.job.needs.gpus
        if not task.on_gpu or not self._free:
            return {}
        share, tiny = min(wanted, 1.0), 1e-6
        free = [gpu for gpu, left in self._free.items() if left > share - tiny]
        count = max(1, int(wanted))
        return dict.fromkeys(free[:count], share) if len(free) >= count else None


def gpus_here() -> list[str]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES has them."""
    stated = os.environ.get("CUDA_VISIBLE_DEVICES")
    if stated is not None:
        return [name for name in stated.split(",") if name.strip() not in ("", "-1")]
    try:
        done = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return []
    count = sum(line.startswith("GPU ") for line in done.stdout.splitlines())
    return [str(number) for number in range(count)]


def too_many_gpus(job: Job, expected: str) -> InputError:
    """Return the refusal of a job that asks for more GPUs than there are."""
    return InputError(
        f"{job.subject}: resources: gpus",
        expected=expected,
        received=f"{job.needs.gpus:g}",
        remedy="`resources: {gpus: 0}` in the job file trains on cores",
    )
