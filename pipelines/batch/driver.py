"""Drive a batch: begin it or go on with it, hand its subjects to an executor, and settle what comes back."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from shutil import rmtree

from pipelines.batch.executors import Executor, Outcome, Task
from pipelines.batch.hold import BATCH_HOLD, JOB_HOLD, Hold, at_work, request_stop, stop_requested, withdraw_stop
from pipelines.batch.jobs import Job, JobFile
from pipelines.batch.records import (
    BATCH_FILE,
    FINAL,
    RUN_FOLDER,
    Batch,
    JobRecord,
    current_key,
    read_batch,
    read_job,
    records_of,
    save_batch,
    save_job,
    stands,
)
from pipelines.batch.steps import STEPS
from pipelines.runs.layout import ALL_STAGES
from smplxpp import __version__
from smplxpp.core.errors import InputError

log = logging.getLogger(__name__)


@dataclass
class Progress:
    """What the driver reports after each change.

    Attributes:
        total: subjects of the batch.
        states: subjects by state.
        running: subjects at work or queued, in the order in which they began.
        halted: why no others begin; empty while they do.
    """

    total: int
    states: Counter[str] = field(default_factory=Counter)
    running: dict[str, tuple[str, ...]] = field(default_factory=dict)
    halted: str = ""


def take_batch(runs: Path) -> Hold:
    """Take a batch for this process.

    Raises:
        InputError: another process drives it.
    """
    runs.mkdir(parents=True, exist_ok=True)
    remedy = "wait for its end, or end it with `smplxpp batch stop`; `smplxpp batch status` shows it"
    return Hold(runs / BATCH_HOLD, subject=f"batch {runs}", remedy=remedy)


def begin_batch(file: JobFile, path: Path, *, upgrade: bool = False) -> tuple[Batch, list[Job]]:
    """Begin a batch, or go on with it; return its record and the jobs of which something does not stand.

    The caller holds the batch.

    Args:
        file: the job file's content.
        path: of the job file.
        upgrade: go on with other code than the batch began with: what stands is made again where the code of its
            stages is another, and unfinished trainings begin again.

    Raises:
        InputError: the batch began with other code.
    """
    runs, key = file.out, current_key()
    before = read_batch(runs) if (runs / BATCH_FILE).exists() else None
    stale = before is not None and before.code_key != key
    if before is not None and stale and not upgrade:
        raise InputError(
            f"batch {runs}",
            expected=f"the code that it began with, smplxpp {before.version} ({before.code_key[:12]})",
            received=f"smplxpp {__version__} ({key[:12]})",
            remedy="install that version again, or give --upgrade: then what is affected is made again",
        )
    withdraw_stop(runs)
    batch = Batch.of(file, path, key=key, started=None if before is None else before.started)
    save_batch(runs, batch)
    return batch, [job for job in file.jobs if _prepare(runs, job, stale=stale)]


def drive(
    runs: Path,
    jobs: Sequence[Job],
    executor: Executor,
    *,
    total: int = 0,
    retries: int = 2,
    report: Callable[[Progress], None] = lambda progress: None,
    held: Hold | None = None,
) -> Progress:
    """Run jobs to their ends, until a stop is asked for or a disk is full.

    Args:
        runs: RUNS.
        jobs: what `begin_batch` returned.
        executor: where they run.
        total: subjects of the batch, those that stand included.
        retries: times that a task is queued again whose machine was lost.
        report: called after each change, and about every second.
        held: the batch's hold; when it is lost to another machine, nothing else begins.
    """
    pending = deque(Task.of(job, parts_of(job, splits=executor.splits)) for job in jobs)
    progress = Progress(total or len(jobs), Counter(done=(total or len(jobs)) - len(jobs), waiting=len(jobs)))
    tries: Counter[tuple[str, tuple[str, ...]]] = Counter()
    withdrawn = False
    for job in jobs:
        executor.check(job)
    try:
        while pending or progress.running:
            progress.halted = progress.halted or _reason_to_halt(runs, held)
            if progress.halted and not withdrawn:
                withdrawn = True
                for task in executor.withdraw():
                    progress.running.pop(task.job.subject, None)
            if progress.halted:
                pending.clear()
            # The first that fits begins, so that a job that waits for a GPU lets others pass.
            for task in list(pending):
                if len(progress.running) < len(jobs) and executor.room(task):
                    pending.remove(task)
                    executor.submit(task)
                    progress.running[task.job.subject] = task.steps
            for task, outcome in executor.ended(1.0):
                progress.running.pop(task.job.subject, None)
                again = _settle(runs, task, outcome, progress, tries, retries)
                if again is not None and not progress.halted:
                    pending.appendleft(again) if again.steps != task.steps else pending.append(again)
            report(progress)
    except BaseException:
        # Ctrl-C ends the running commands kindly, as `batch stop` does.
        request_stop(runs)
        for task in executor.withdraw():
            progress.running.pop(task.job.subject, None)
        while progress.running and (ended := executor.ended(60.0)):
            for task, _ in ended:
                progress.running.pop(task.job.subject, None)
        raise
    finally:
        executor.close()
    report(progress)
    return progress


def parts_of(job: Job, *, splits: bool) -> tuple[tuple[str, ...], ...]:
    """Return a chain in parts, each of steps that take the same of a machine.

    Example:
        >>> parts_of(Job("anna", "anna", steps=("check", "build", "train", "evaluate", "export")), splits=True)
        (('check', 'build'), ('train', 'evaluate'), ('export',))
    """
    if not splits or not job.needs.gpus:
        return (job.steps,)
    return tuple(tuple(steps) for _, steps in groupby(job.steps, key=lambda step: STEPS[step].on_gpu))


def retry(runs: Path, subjects: Sequence[str] = ()) -> list[str]:
    """Put back what failed or was refused, so that the next start runs it again; return the subjects.

    Args:
        runs: RUNS, which the caller holds.
        subjects: only these; empty: all.
    """
    out = []
    for record in records_of(runs, read_batch(runs)):
        if record.state in ("failed", "refused") and (not subjects or record.subject in subjects):
            for step in record.steps:
                if step.state in ("failed", "refused"):
                    step.state, step.failures = "waiting", 0
            record.settle()
            save_job(runs, record)
            out.append(record.subject)
    return out


def _prepare(runs: Path, job: Job, *, stale: bool) -> bool:
    """Put a subject's record into the state from which it continues; whether anything of it does not stand."""
    folder = runs / job.subject
    record = read_job(runs, job.subject)
    if record is None:
        return True
    if at_work(folder / JOB_HOLD):  # a worker of a driver that is gone: its task is waited for
        return True
    known = {step.step for step in record.steps}
    if stale:
        for step in record.steps:
            step.state = "waiting"
        for stage in ALL_STAGES:
            rmtree(folder / RUN_FOLDER / f"{stage}_work", ignore_errors=True)
    elif record.state in FINAL and set(job.steps) <= known:
        # A failure stays until a retry, unless the job asks for something else now.
        if record.state != "done":
            return False
        return not all(stands(folder, job, record.step(step)) for step in job.steps)
    for step in record.steps:
        step.failures = 0
        step.state = "waiting" if step.state == "stopped" else step.state
    record.settle()
    save_job(runs, record)
    return True


def _reason_to_halt(runs: Path, held: Hold | None) -> str:
    """Return why no other subject may begin; empty where none."""
    if stop_requested(runs):
        return "a stop was asked for"
    if held is not None and held.lost:
        return "another process has taken the batch, because this one did not reach the disk for some time"
    return ""


def _settle(
    runs: Path,
    task: Task,
    outcome: Outcome,
    progress: Progress,
    tries: Counter[tuple[str, tuple[str, ...]]],
    retries: int,
) -> Task | None:
    """Take note of a task's end; return the task that continues with its chain, or None."""
    subject, key = task.job.subject, (task.job.subject, task.steps)
    if isinstance(outcome, BaseException):
        return _lost(runs, task, outcome, progress, tries, retries)
    meaning, state = outcome["meaning"], outcome["state"]
    if meaning == "done" and state == "waiting" and task.rest:
        return Task.of(task.job, task.rest)
    # A training at its limit continues as often as it takes; a subject that another process holds is asked for again.
    if meaning == "again":
        return task
    if meaning == "busy":
        tries[key] += 1
        if tries[key] <= retries:
            return task
    if meaning in ("disk", "code"):
        words = outcome.get("message") or _last_error(runs, subject)
        progress.halted = progress.halted or f"{subject}: {words}"
    progress.states["waiting"] -= 1
    progress.states[state] += 1
    return None


def _lost(
    runs: Path,
    task: Task,
    error: BaseException,
    progress: Progress,
    tries: Counter[tuple[str, tuple[str, ...]]],
    retries: int,
) -> Task | None:
    """Take note of a task that came to no end: its machine was lost, or its record could not be written."""
    subject, key = task.job.subject, (task.job.subject, task.steps)
    words = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    log.warning("%s: %s", subject, words)
    tries[key] += 1
    if tries[key] <= retries and not isinstance(error, InputError):
        return task
    record = read_job(runs, subject) or JobRecord.of(task.job)
    step = next((step for step in record.steps if step.state != "done"), record.steps[-1])
    step.state, step.error = "failed", {"message": words}
    record.settle()
    save_job(runs, record)
    progress.states["waiting"] -= 1
    progress.states["failed"] += 1
    return None


def _last_error(runs: Path, subject: str) -> str:
    record = read_job(runs, subject)
    errors = [step.error for step in record.steps if step.error] if record else []
    return str(errors[-1].get("message", "")) if errors else "no word of it"
