"""Where the calls of `run_job` run: threads of this machine, tasks of a Ray cluster, or job arrays of Slurm."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from pipelines.batch.jobs import Job
from pipelines.batch.run_job import Resources, run_job
from pipelines.batch.steps import STEPS
from smplxpp.core.errors import InputError, MissingExtraError

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
            raise _too_many_gpus(job, f"at most {len(self._free)}, which this machine has")

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


class RayExecutor:
    """Tasks of a Ray cluster; Ray starts a task again whose worker or node was lost.

    Args:
        runs: RUNS, which all nodes see under this path.
        resources: of each task.
        address: of the cluster, or `auto`.
    """

    splits = True

    def __init__(self, runs: Path, resources: Resources, *, address: str) -> None:
        ray = _ray()
        self.runs, self.resources, self._ray = runs, resources, ray
        try:
            # Ray itself tries for minutes to reach an address at which nothing listens.
            host, _, port = address.partition("://")[2 if "://" in address else 0].rpartition(":")
            if host and port.isdigit():
                socket.create_connection((host, int(port)), timeout=20).close()
            if not ray.is_initialized():
                ray.init(address=address, log_to_driver=False, logging_level="warning")
        except (RuntimeError, OSError, ValueError) as error:
            raise InputError(
                f"Ray at {address}",
                expected=f"a cluster of Ray {ray.__version__} and Python {sys.version.split()[0]}, as are here",
                received=" ".join(str(error).split())[:300],
                remedy="start it with `ray start --head`, or install its version of Ray here",
            ) from None
        self._running: dict[Any, Task] = {}

    def check(self, job: Job) -> None:
        """Refuse a job that asks for GPUs of a cluster without any, for which it would wait for ever."""
        trains = any(STEPS[step].on_gpu for step in job.steps)
        if trains and job.needs.gpus and not self._ray.cluster_resources().get("GPU"):
            raise _too_many_gpus(job, "0 on a cluster without GPUs")

    def room(self, task: Task) -> bool:
        """Return True: Ray queues what does not fit."""
        return True

    def submit(self, task: Task) -> None:
        """Queue a task with the CPUs and GPUs that it takes."""
        needs = task.job.needs
        options: dict[str, Any] = {
            "num_cpus": needs.cores or 1,
            "num_gpus": needs.gpus if task.on_gpu else 0,
            "max_retries": self.resources.max_retries,
            "retry_exceptions": False,
            "name": f"{task.job.subject}: {' '.join(task.steps)}",
        }
        if needs.gigabytes:
            options["memory"] = int(1e9 * needs.gigabytes)
        resources = replace(self.resources, steps=task.steps, threads=needs.cores or 1, minutes=needs.minutes)
        call = self._ray.remote(run_job).options(**options)
        self._running[call.remote(task.job, self.runs / task.job.subject, resources)] = task

    def ended(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Wait for tasks to end."""
        if not self._running:
            return []
        done, _ = self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        out: list[tuple[Task, Outcome]] = []
        for reference in done:
            task = self._running.pop(reference)
            try:
                out.append((task, self._ray.get(reference)))
            except self._ray.exceptions.RayError as error:
                out.append((task, error))
        return out

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


class SlurmExecutor:
    """Job arrays of Slurm by submitit; a task that Slurm ends or preempts continues in the next array.

    Args:
        runs: RUNS.
        resources: of each task.
        partition: of Slurm; empty: its default.
        minutes: limit of a task whose job names none.
        cluster: `slurm`, or `local` and `debug`, which run the same without Slurm.
    """

    splits = True

    def __init__(
        self, runs: Path, resources: Resources, *, partition: str = "", minutes: float = 1440.0, cluster: str = "slurm"
    ) -> None:
        self.runs, self.resources, self.minutes, self.cluster = runs, resources, minutes, cluster
        self.partition = partition
        self._submitit = _submitit()
        self._waiting: list[Task] = []
        self._running: list[tuple[Task, Any]] = []

    def check(self, job: Job) -> None:
        """Leave it to Slurm, which knows its partitions."""

    def room(self, task: Task) -> bool:
        """Return True: Slurm queues what does not fit."""
        return True

    def submit(self, task: Task) -> None:
        """Take a task into the next arrays."""
        self._waiting.append(task)

    def ended(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Send what is waiting, an array for tasks that take the same, and wait for tasks to end."""
        alike: dict[tuple[Any, bool], list[Task]] = {}
        for task in self._waiting:
            alike.setdefault((task.job.needs, task.on_gpu), []).append(task)
        self._waiting = []
        for tasks in alike.values():
            self._send(tasks)
        until = time.monotonic() + seconds
        while time.monotonic() < until and not any(job.done() for _, job in self._running):
            time.sleep(min(seconds, 0.2))
        out: list[tuple[Task, Outcome]] = []
        still = []
        for task, job in self._running:
            if not job.done():
                still.append((task, job))
                continue
            error = job.exception()
            out.append((task, job.result() if error is None else error))
        self._running = still
        return out

    def close(self) -> None:
        """Leave the arrays to Slurm; `batch stop` ends them by their records."""

    def _send(self, tasks: list[Task]) -> None:
        needs, on_gpu = tasks[0].job.needs, tasks[0].on_gpu
        minutes = needs.minutes or self.minutes
        executor = self._submitit.AutoExecutor(folder=self.runs / "cluster" / "%A", cluster=self.cluster)
        executor.update_parameters(
            name="smplxpp",
            timeout_min=max(1, int(minutes)),
            cpus_per_task=needs.cores or 1,
            gpus_per_node=int(-(-needs.gpus // 1)) if on_gpu else 0,
            **({"mem_gb": needs.gigabytes} if needs.gigabytes else {}),
            **({"slurm_partition": self.partition} if self.partition else {}),
        )
        resources = [
            replace(self.resources, steps=task.steps, threads=needs.cores or 1, minutes=minutes) for task in tasks
        ]
        folders = [self.runs / task.job.subject for task in tasks]
        jobs = executor.map_array(RequeuedJob(), [task.job for task in tasks], folders, resources)
        self._running += zip(tasks, jobs, strict=True)


class RequeuedJob:
    """`run_job` as submitit calls it: before Slurm's limit, or when it preempts, the same call is queued again."""

    def __call__(self, job: Job, folder: Path, resources: Resources) -> dict[str, Any]:
        """Run the chain."""
        return run_job(job, folder, resources)

    def checkpoint(self, *arguments: Any) -> Any:
        """Return the call that continues: what stands is on the disk."""
        return _submitit().helpers.DelayedSubmission(self, *arguments)


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


def _too_many_gpus(job: Job, expected: str) -> InputError:
    return InputError(
        f"{job.subject}: resources: gpus",
        expected=expected,
        received=f"{job.needs.gpus:g}",
        remedy="`resources: {gpus: 0}` in the job file trains on cores",
    )


def _ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError:
        raise MissingExtraError("ray", extra="cluster", purpose="a batch on Ray") from None
    return ray


def _submitit() -> Any:
    try:
        import submitit
    except ImportError:
        raise MissingExtraError("submitit", extra="cluster", purpose="a batch on Slurm") from None
    return submitit
