"""Clusters that run the calls of `run_job`: tasks of Ray, and job arrays of Slurm, with or without its accounting."""

from __future__ import annotations

import hashlib
import logging
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pipelines.batch.executors import Outcome, Task, too_many_gpus
from pipelines.batch.hold import JOB_HOLD, at_work
from pipelines.batch.jobs import Job
from pipelines.batch.run_job import Resources, run_job
from pipelines.batch.steps import STEPS
from smplxpp.core.errors import InputError
from smplxpp.core.lazy import import_extra

log = logging.getLogger(__name__)


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
            raise too_many_gpus(job, "0 on a cluster without GPUs")

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

    def withdraw(self) -> list[Task]:
        """Take back what has not begun, whose subjects no process holds."""
        out = []
        for reference, task in list(self._running.items()):
            if not at_work(self.runs / task.job.subject / JOB_HOLD):
                self._ray.cancel(reference)
                out.append(self._running.pop(reference))
        return out

    def close(self) -> None:
        """Leave the cluster."""
        self._ray.shutdown()


class SlurmExecutor:
    """Job arrays of Slurm by submitit; a task that Slurm ends or preempts is queued again, by Slurm or by the driver.

    A task has ended when its answer lies in `RUNS/cluster/ARRAY`. One that left Slurm's queue without an answer is
    lost: `squeue` tells that on every cluster, while `sacct`, which submitit asks, needs a database that many lack.

    Args:
        runs: RUNS.
        resources: of each task.
        partition: of Slurm; empty: its default.
        minutes: limit of a task whose job names none.
        cluster: `slurm`, or `local` and `debug`, which run the same without Slurm.
        every: seconds between two looks at the queue.
    """

    splits = True

    def __init__(
        self,
        runs: Path,
        resources: Resources,
        *,
        partition: str = "",
        minutes: float = 1440.0,
        cluster: str = "slurm",
        every: float = 15.0,
    ) -> None:
        self.runs, self.resources, self.minutes, self.cluster = runs, resources, minutes, cluster
        self.partition, self.every = partition, every
        self._submitit = _submitit()
        if cluster == "slurm" and shutil.which("sbatch") is None:
            raise InputError(
                "Slurm", expected="sbatch, squeue and scancel", received="none", remedy="start it on a login node"
            )
        self._waiting: list[Task] = []
        self._running: list[tuple[Task, Any]] = []
        self._looked, self._again, self._absent = time.monotonic(), 0.0, set[str]()
        cancel_queued(runs)  # those of a driver that was killed

    def check(self, job: Job) -> None:
        """Refuse a job that asks for GPUs of a partition without any; Slurm would refuse it when its build is done."""
        trains = any(STEPS[step].on_gpu for step in job.steps)
        if trains and job.needs.gpus and not self._has_gpus:
            raise too_many_gpus(job, f"0 in a partition without GPUs ({self.partition or 'the default one'})")

    @cached_property
    def _has_gpus(self) -> bool:
        """Whether a node of the partition lists GPUs among its generic resources; True where Slurm does not tell."""
        if self.cluster != "slurm":
            return True
        chosen = [f"--partition={self.partition}"] if self.partition else []
        try:
            words = ["sinfo", "--noheader", "--format=%P %G", *chosen]
            done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return True
        # A line a group of nodes; the default partition's name ends with a star.
        lines = [line.split(maxsplit=1) for line in done.stdout.splitlines() if len(line.split()) > 1]
        own = lines if self.partition else [line for line in lines if line[0].endswith("*")]
        return done.returncode != 0 or not own or any("gpu" in resources for _, resources in own)

    def room(self, task: Task) -> bool:
        """Return True, as Slurm queues what does not fit, unless a killed driver's worker is still at the subject."""
        return not at_work(self.runs / task.job.subject / JOB_HOLD)

    def submit(self, task: Task) -> None:
        """Take a task into the next arrays."""
        self._waiting.append(task)

    def ended(self, seconds: float) -> list[tuple[Task, Outcome]]:
        """Send what is waiting, an array for tasks that take the same, and wait for tasks to end."""
        if self._waiting and time.monotonic() >= self._again:
            self._send_waiting()
        until = time.monotonic() + seconds
        while True:
            done = self._done()
            if done or time.monotonic() >= until:
                break
            time.sleep(min(seconds, 0.25))
        out: list[tuple[Task, Outcome]] = []
        for task, job in [pair for pair in self._running if pair[1].job_id in done]:
            error = done[job.job_id] or job.exception()
            # Of an error on the node the last line of its trace says what it was.
            words = "" if error is None else (str(error).split("-" * 22)[-2:-1] or [str(error)])[0].strip()
            lost = RuntimeError(f"{words.splitlines()[-1]}; see {job.paths.stderr}") if words else error
            out.append((task, job.result() if error is None else lost))
        self._running = [pair for pair in self._running if pair[1].job_id not in done]
        return out

    def withdraw(self) -> list[Task]:
        """Take back what waits in the queue; what runs goes on."""
        out, self._waiting = self._waiting, []
        cancel_queued(self.runs)
        queue = self._queue()
        if queue is not None:
            out += [task for task, job in self._running if job.job_id not in queue]
            self._running = [pair for pair in self._running if pair[1].job_id in queue]
        return out

    def close(self) -> None:
        """Take back what still waits in the queue; the next start sends it again."""
        cancel_queued(self.runs)

    def _done(self) -> dict[str, Exception | None]:
        """Return the tasks that have ended by their numbers, with an error for those that are lost."""
        if self.cluster != "slurm":
            return {job.job_id: None for _, job in self._running if job.done()}
        # A listing asks the server of a shared disk once an array, and is not older than this moment.
        listed = {
            name
            for folder in {job.paths.folder for _, job in self._running}
            if folder.is_dir()
            for name in (path.name for path in folder.iterdir())
        }
        done: dict[str, Exception | None] = {
            job.job_id: None for _, job in self._running if job.paths.result_pickle.name in listed
        }
        if time.monotonic() - self._looked < self.every:
            return done
        self._looked, queue = time.monotonic(), self._queue()
        if queue is None:
            return done
        # Absent at two looks: between the first and the second an answer has reached every machine.
        absent = {job.job_id for _, job in self._running} - queue - done.keys()
        for _, job in self._running:
            if job.job_id in absent & self._absent:
                words = f"job {job.job_id} left Slurm's queue without an answer: cancelled, or its machine lost"
                done[job.job_id] = RuntimeError(words)
        self._absent = absent
        return done

    def _queue(self) -> set[str] | None:
        """Return the numbers of the batch's tasks in Slurm's queue; None where Slurm does not answer."""
        words = ["squeue", f"--name={_name(self.runs)}", "--array", "--noheader", "--format=%i"]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return set(done.stdout.split()) if done.returncode == 0 else None

    def _send_waiting(self) -> None:
        """Send tasks that take the same as arrays; what Slurm refuses while others run is sent again later."""
        most = 1000  # of an array: the greatest index is 1000 where a site has not set MaxArraySize
        alike: dict[tuple[Any, bool], list[Task]] = {}
        for task in self._waiting:
            alike.setdefault((task.job.needs, task.on_gpu), []).append(task)
        arrays = [tasks[at : at + most] for tasks in alike.values() for at in range(0, len(tasks), most)]
        for tasks in arrays:
            try:
                self._send(tasks)
            except (self._submitit.core.utils.FailedJobError, self._submitit.core.utils.FailedSubmissionError) as error:
                words = " ".join(str(error).split())[-300:]
                if not self._running and not any(sign in words for sign in ("nable to contact", "timed out")):
                    raise InputError(
                        "an array of Slurm",
                        expected="partition, cores, GPUs, memory and minutes that it has",
                        received=words,
                        remedy="see --partition, --minutes and `resources`; sbatch reads SBATCH_ACCOUNT and SBATCH_QOS",
                    ) from None
                log.warning("Slurm took no array, and is asked again: %s", words)
                self._again = time.monotonic() + 60.0
                return
            self._waiting = [task for task in self._waiting if task not in tasks]

    def _send(self, tasks: Sequence[Task]) -> None:
        needs, on_gpu = tasks[0].job.needs, tasks[0].on_gpu
        minutes = needs.minutes or self.minutes
        executor = self._submitit.AutoExecutor(folder=self.runs / "cluster" / "%A", cluster=self.cluster)
        executor.update_parameters(
            name=_name(self.runs),
            timeout_min=max(1, int(minutes)),
            cpus_per_task=needs.cores or 1,
            slurm_array_parallelism=len(tasks),
            **({"gpus_per_node": int(-(-needs.gpus // 1))} if on_gpu else {}),
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
        """Run the chain; SIGTERM, which submitit lets pass, ends its command kindly and costs it no attempt."""

        def leave(number: int, frame: object) -> None:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            raise SystemExit(128 + number)

        with suppress(ValueError):  # not the main thread, which gets no signals
            signal.signal(signal.SIGTERM, leave)
        return run_job(job, folder, resources)

    def checkpoint(self, *arguments: Any) -> Any:
        """Return the call that continues: what stands is on the disk."""
        # The requeue that follows sends SIGTERM into the middle of the clearing up.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        return _submitit().helpers.DelayedSubmission(self, *arguments)


def cancel_queued(runs: Path) -> None:
    """Take a batch's tasks that wait in Slurm's queue out of it; nothing where it has none."""
    if (runs / "cluster").is_dir() and shutil.which("scancel"):
        words = ["scancel", f"--name={_name(runs)}", "--state=PENDING"]
        with suppress(OSError, subprocess.TimeoutExpired):
            subprocess.run(words, capture_output=True, timeout=60, check=False)


def _name(runs: Path) -> str:
    """Return the name of a batch's jobs in Slurm's queue, its own among those of other batches."""
    return f"smplxpp-{hashlib.sha256(str(runs.resolve()).encode()).hexdigest()[:10]}"


def _ray() -> Any:
    ray = import_extra("ray", extra="cluster", purpose="a batch on Ray")
    import_extra("ray.exceptions", extra="cluster", purpose="a batch on Ray")
    return ray


def _submitit() -> Any:
    return import_extra("submitit", extra="cluster", purpose="a batch on Slurm")
