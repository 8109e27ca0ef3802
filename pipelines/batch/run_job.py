"""Run a subject's chain of commands, from where it stands: the one function that this machine, Ray and Slurm all call.

Its records are on the disk before and after each command, so that it may be killed at any moment and called again, on
any machine that sees RUNS. It returns a small dictionary, which drivers need for nothing but their next decision.
"""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.batch.hold import JOB_HOLD, Hold, stop_requested
from pipelines.batch.jobs import Job
from pipelines.batch.process import Ended, Meaning, end_orphan, meaning_of, own_program, run_process
from pipelines.batch.records import (
    LOGS,
    JobRecord,
    State,
    StepRecord,
    asked_of,
    current_key,
    now,
    proofs_of,
    read_job,
    save_job,
    stands,
)
from pipelines.batch.steps import STEPS
from pipelines.batch.stores import Store
from pipelines.runs.folders import keep_out_of_capture
from smplxpp.core.errors import InputError, MissingExtraError

_STATES: Mapping[Meaning, State] = {
    "done": "done",
    "refused": "refused",
    "failed": "failed",
    "system": "failed",
    "disk": "waiting",
    "busy": "waiting",
    "again": "waiting",
    "stopped": "stopped",
    "code": "waiting",
}


@dataclass(frozen=True)
class Resources:
    """What one call of `run_job` may use.

    Attributes:
        threads: OMP_NUM_THREADS of its commands; 0: as the environment says.
        gpus: CUDA_VISIBLE_DEVICES of its commands; None: as the environment says, as Ray and Slurm set it.
        steps: steps of this call; empty: all.
        minutes: of this call, after which a training stops and continues in the next; 0: no limit.
        max_retries: attempts of a step after the first that the system's failures may cost.
        code_key: that of the batch, which the installed code has to have; empty: any.
        scratch: folder on a local disk for what is copied from addresses.
        results: address that a finished subject's folder is copied to; empty: none.
        folder: working directory of the commands, at which their relative paths start.
        program: words that start a command; empty: `smplxpp` in this Python.
        wait: seconds to wait for another process that holds the subject, as one on a lost machine seems to.
    """

    threads: int = 0
    gpus: str | None = None
    steps: tuple[str, ...] = ()
    minutes: float = 0.0
    max_retries: int = 2
    code_key: str = ""
    scratch: str = ""
    results: str = ""
    folder: str = "."
    program: tuple[str, ...] = ()
    wait: float = 150.0


def run_job(job: Job, folder: Path, resources: Resources) -> dict[str, Any]:
    """Run what does not stand of a subject's chain.

    Args:
        job: the subject.
        folder: its folder in RUNS.
        resources: what may be used.

    Returns:
        `subject`, `state` of the chain, `meaning` of the last command's end, `ran` (names of the steps whose commands
        were started), `seconds` and, where no record could be written, `message`. The meanings `disk` and `code` ask
        the driver to begin nothing else, `again` and `busy` to call once more.
    """
    begin, runs = time.monotonic(), folder.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _patient_hold(job, folder, resources) as hold:
            # The limit of a stay counts from here: a hold may have been waited for.
            chain = _Chain(job, folder, resources, begin=begin, stop=lambda: hold.lost or stop_requested(runs))
            meaning = chain.run()
    except _BusyError as busy:
        return _result(job, "waiting", busy.meaning, [], begin)
    except OSError as error:
        # Ray and submitit hand an error on as text, in which the driver cannot see that a disk is full.
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            raise
        return {**_result(job, "waiting", "disk", [], begin), "message": str(error)}
    return _result(job, chain.record.state, meaning, chain.ran, begin)


class _BusyError(Exception):
    """Another process holds the subject, or a stop came while it was waited for."""

    def __init__(self, meaning: Meaning) -> None:
        super().__init__(meaning)
        self.meaning = meaning


def _patient_hold(job: Job, folder: Path, resources: Resources) -> Hold:
    """Take the subject; a holder on a machine that was lost is waited for until it counts as lost."""
    until = time.monotonic() + resources.wait
    while True:
        hold = Hold(folder / JOB_HOLD, subject=f"subject {job.subject}")
        try:
            return hold.take()
        except InputError:
            if stop_requested(folder.parent):
                raise _BusyError("stopped") from None
            if time.monotonic() > until:
                raise _BusyError("busy") from None
            time.sleep(min(2.0, resources.wait))


def _result(job: Job, state: State, meaning: Meaning, ran: Sequence[str], begin: float) -> dict[str, Any]:
    seconds = round(time.monotonic() - begin, 3)
    return {"subject": job.subject, "state": state, "meaning": meaning, "ran": list(ran), "seconds": seconds}


class _Chain:
    """The steps of one call, in their order, and the record that they keep."""

    def __init__(self, job: Job, folder: Path, resources: Resources, *, begin: float, stop: Callable[[], bool]) -> None:
        self.job, self.folder, self.resources, self.stop = job, folder, resources, stop
        self.record = _joined(read_job(folder.parent, job.subject), job)
        self.ran: list[str] = []
        self.begin = begin
        self.store = Store(job, folder, resources.scratch)

    def run(self) -> Meaning:
        """Run the steps until one does not end well; what that one's end means."""
        wanted = self.resources.steps or self.job.steps
        meaning: Meaning = "done"
        self._end_orphans()
        for step in self.record.steps:
            if step.step not in wanted:
                if step.state != "done":  # a step before or behind this call's has to be made by another
                    break
                continue
            command = self.job.command(step.step, self.folder, self.store.local)
            # Final ends stay until a retry is asked for.
            if step.state in ("failed", "refused"):
                break
            if stands(self.folder, self.job, step):
                continue
            if self.stop():
                step.state, meaning = "stopped", "stopped"
            elif self.resources.code_key and current_key() != self.resources.code_key:
                meaning = "code"
                words = f"another version of smplxpp is installed on {socket.gethostname()} than the batch began with"
                step.error = {"message": words}
            else:
                meaning = self._attempts(step, command)
            self._save()
            if step.state != "done":
                break
        self._save()
        if self.record.state == "done" and self.resources.results:
            meaning = self._send()
        # What was fetched to scratch goes when no step will read it: a retry may come for what failed.
        if self.record.state == "done":
            self.store.clear()
        return meaning

    def _attempts(self, step: StepRecord, command: list[str]) -> Meaning:
        """Run a step's command, again after failures of the system; what its last end means."""
        step.proofs, step.error, step.command = {}, None, command
        step.asked = asked_of(self.job, step.step)
        # What comes behind it is made of it.
        for later in self.record.steps[self.record.steps.index(step) + 1 :]:
            later.state = "waiting" if later.state == "done" else later.state
        try:
            keep_out_of_capture(self.folder, Path(self.store.local) if self.job.capture else None, subject="out")
            self.store.fetch(stop=self.stop)
        except (InputError, MissingExtraError, OSError) as error:
            return self._refuse(step, error)
        while True:
            meaning, step.error = self._attempt(step)
            step.state = _STATES[meaning]
            if meaning == "done":
                step.proofs = proofs_of(self.folder, self.job, step.step)
            if meaning != "system":
                return meaning
            step.failures += 1
            if step.failures > self.resources.max_retries:
                return meaning
            step.state = "waiting"
            self._save()

    def _attempt(self, step: StepRecord) -> tuple[Meaning, dict[str, Any] | None]:
        """Run a step's command once, and keep what it used in the record."""
        kind = STEPS[step.step]
        log, answer = (self.folder / LOGS / f"{step.step}.{suffix}" for suffix in ("log", "json"))
        log.parent.mkdir(exist_ok=True)
        words, environment = self._program(step)
        step.state, step.started, step.ended = "running", now(), None
        step.attempts, step.host, step.exit_status = step.attempts + 1, socket.gethostname(), None
        step.log, step.answer = f"{LOGS}/{log.name}", f"{LOGS}/{answer.name}"
        step.gpu = environment.get("CUDA_VISIBLE_DEVICES", "") if kind.on_gpu else ""
        self.ran.append(step.step)

        def began(pid: int) -> None:
            step.pid = pid
            self._save()

        begin = time.monotonic()
        try:
            ended = run_process(
                [*words, *step.command, *self._limit(step), *self._processes(step, environment)],
                log=log,
                answer=answer,
                environment=environment,
                folder=Path(self.resources.folder),
                stop=self.stop,
                began=began,
            )
        except (KeyboardInterrupt, SystemExit):  # Slurm takes the machine back: no failure of the step
            step.state, step.seconds = "waiting", round(step.seconds + time.monotonic() - begin, 3)
            self._save()
            raise
        _add(step, ended)
        return meaning_of(ended, log=log, answer=answer, judged=kind.judged and step.step not in self.job.accept)

    def _program(self, step: StepRecord) -> tuple[list[str], dict[str, str]]:
        """Return the words that start a step's command, and its variables."""
        own, variables = own_program()
        words, resources, needs = list(self.resources.program or own), self.resources, self.job.needs
        if resources.threads:
            variables["OMP_NUM_THREADS"] = str(resources.threads)
        if not STEPS[step.step].on_gpu or not needs.gpus:
            variables["CUDA_VISIBLE_DEVICES"] = ""
        elif resources.gpus is not None:
            variables["CUDA_VISIBLE_DEVICES"] = resources.gpus
        return words, variables

    def _processes(self, step: StepRecord, variables: Mapping[str, str]) -> list[str]:
        """Return the option of a training on several GPUs, which has a process for each; its own option goes first."""
        visible = variables.get("CUDA_VISIBLE_DEVICES", os.environ.get("CUDA_VISIBLE_DEVICES", ""))
        count = len(list(filter(None, visible.split(","))))
        none = step.step != "train" or count < 2 or self.resources.program or "--processes" in step.command
        return [] if none else ["--processes", str(count)]

    def _limit(self, step: StepRecord) -> list[str]:
        """Return the option that ends a training before the machine does; its own option goes first."""
        if step.step not in ("refine", "train") or not self.resources.minutes or "--max-minutes" in step.command:
            return []
        # The last models, the report and a checkpoint are written after the limit.
        left = self.resources.minutes - (time.monotonic() - self.begin) / 60
        return ["--max-minutes", f"{max(0.95 * left - 2.0, 0.5):.1f}"]

    def _refuse(self, step: StepRecord, error: Exception) -> Meaning:
        """Keep an error that came before the command: a capture that is not there, a scratch disk that is full."""
        fields = ("subject", "expected", "received", "remedy")
        step.error = {"type": type(error).__name__, "message": str(error)}
        step.error |= {name: getattr(error, name) for name in fields if hasattr(error, name)}
        number = error.errno if isinstance(error, OSError) else None
        kinds: dict[int | None, Meaning] = {None: "refused", errno.ENOSPC: "disk", errno.EINTR: "stopped"}
        meaning = kinds.get(number, "system")
        step.state = _STATES[meaning]
        return meaning

    def _send(self) -> Meaning:
        """Copy a finished subject's folder to its address."""
        try:
            self.store.send(self.resources.results)
            self.record.note = f"copied to {self.resources.results}"
        except (InputError, OSError) as error:
            self.record.note = f"not copied to {self.resources.results}: {error}"
        save_job(self.folder.parent, self.record)
        return "done"

    def _end_orphans(self) -> None:
        """End commands of a driver on this machine that was killed, and put their steps back."""
        for step in self.record.steps:
            if step.state == "running":
                if step.host == socket.gethostname():
                    end_orphan(step.pid, str(self.folder))
                step.failures += 1
                step.state = "waiting"
            if step.failures > self.resources.max_retries and step.state == "waiting":
                step.state = "failed"
                step.error = step.error or {"message": f"its machine or worker was lost {step.failures} times"}

    def _save(self) -> None:
        self.record.settle()
        with suppress(FileNotFoundError):  # the folder of a test that is over
            save_job(self.folder.parent, self.record)


def _joined(found: JobRecord | None, job: Job) -> JobRecord:
    """Return a subject's record with the steps that its job has now."""
    record = JobRecord.of(job)
    known = {} if found is None else {step.step: step for step in found.steps}
    record.steps = [known.get(step.step, step) for step in record.steps]
    return record


def _add(step: StepRecord, ended: Ended) -> None:
    """Add what an attempt used to a step's record."""
    step.ended, step.exit_status, step.pid = now(), ended.exit_status, 0
    step.seconds = round(step.seconds + ended.seconds, 3)
    step.cpu_seconds = round(step.cpu_seconds + ended.cpu_seconds, 3)
    step.peak_mb = round(max(step.peak_mb, ended.peak_mb), 1)
