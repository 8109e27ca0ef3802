"""Read and write the records of a batch: `RUNS/batch.json`, and `RUNS/SUBJECT/job.json` for each subject.

They are the only truth about a batch: drivers, workers and pages read them, and none keeps a state of its own. A file
has one writer at a time (`pipelines.batch.hold`) and is replaced whole, so that readers need no lock.

| state | of a step or a job |
|---|---|
| waiting | has not begun, or was interrupted and continues where it stood |
| running | a process works on it |
| done | came to its end, and its checks passed or are accepted |
| failed | its checks failed, or the system's failures used up its attempts |
| refused | its command refused the input, in three sentences |
| stopped | `batch stop` ended it |
"""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
import sys
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any, Literal, cast, get_args

from pipelines.batch.jobs import Job, JobFile
from pipelines.batch.steps import STEPS
from pipelines.runs.code import PACKAGES, TRAINING, code_of, sha256_file, versions
from pipelines.runs.folders import require_plain_fields
from smplxpp import __version__
from smplxpp.core.errors import InputError, require_choice
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_list, as_object, as_text, read_json
from smplxpp.core.files.paths import regular_file

FORMAT, VERSION = "smplxpp batch", 1
BATCH_FILE, JOB_FILE, RUN_FOLDER, LOGS = "batch.json", "job.json", "run", "logs"
State = Literal["waiting", "running", "done", "failed", "refused", "stopped"]
FINAL = ("done", "failed", "refused")
"""States that a new start of the batch leaves as they are."""


@dataclass
class StepRecord:
    """A step of a subject's chain.

    Attributes:
        step: its name.
        command: words of its last process.
        state: see above.
        started: when its last attempt began, UTC.
        ended: when that ended, UTC.
        seconds: by the clock, over all attempts.
        cpu_seconds: of its processes, over all attempts.
        peak_mb: largest memory of one of its processes, 10^6 bytes.
        gpu: GPUs that it was given, as CUDA_VISIBLE_DEVICES has them; empty: none.
        attempts: processes that were started for it.
        failures: of these, those that the system ended since the batch was last started.
        host: machine of the last attempt.
        pid: process of the last attempt.
        exit_status: of the last attempt; negative: the signal that ended it.
        error: subject, expected, received and remedy of a refusal, or a line as `message`; None without one.
        log: file of its standard error, below RUNS/SUBJECT.
        answer: file of its JSON answer, there too.
        asked: the command as the job asks for it, without places that differ from machine to machine.
        proofs: SHA-256 of the files that prove to a later start that it stands, by their paths there.
    """

    step: str
    command: list[str] = field(default_factory=list)
    state: State = "waiting"
    started: str | None = None
    ended: str | None = None
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0
    gpu: str = ""
    attempts: int = 0
    failures: int = 0
    host: str = ""
    pid: int = 0
    exit_status: int | None = None
    error: dict[str, Any] | None = None
    log: str = ""
    answer: str = ""
    asked: str = ""
    proofs: dict[str, str] = field(default_factory=dict)


@dataclass
class JobRecord:
    """What has become of a subject.

    Attributes:
        subject: its name.
        capture: folder or address of its capture.
        steps: in their order.
        state: of the chain.
        note: a line about the chain as a whole; empty without one.
    """

    subject: str
    capture: str
    steps: list[StepRecord]
    state: State = "waiting"
    note: str = ""

    def step(self, name: str) -> StepRecord:
        """Return the record of a step."""
        return next(step for step in self.steps if step.step == name)

    def settle(self) -> State:
        """Set the state of the chain to what those of its steps say, and return it."""
        states = [step.state for step in self.steps]
        ended = next((state for state in states if state in ("failed", "refused", "stopped", "running")), None)
        self.state = ended or ("done" if all(state == "done" for state in states) else "waiting")
        return self.state

    @staticmethod
    def of(job: Job) -> JobRecord:
        """Return the record of a job that has not begun."""
        return JobRecord(job.subject, job.capture, [StepRecord(step) for step in job.steps])


@dataclass(frozen=True)
class Batch:
    """What `RUNS/batch.json` says.

    Attributes:
        name: of the batch.
        version: of smplxpp that it began with.
        code_key: digest of the code and the libraries that it began with.
        started: when it first began, UTC.
        job_file: the file that it was last started with.
        jobs: {subject, capture, steps} of each, in the file's order.
        more: other entries, as `update_batch` added them.
    """

    name: str
    version: str
    code_key: str
    started: str
    job_file: str
    jobs: tuple[dict[str, Any], ...]
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def subjects(self) -> tuple[str, ...]:
        """Return the subjects in their order."""
        return tuple(job["subject"] for job in self.jobs)

    @staticmethod
    def of(file: JobFile, path: Path, *, key: str, started: str | None = None) -> Batch:
        """Return the record of a batch that begins, or continues."""
        jobs = tuple({"subject": job.subject, "capture": job.capture, "steps": list(job.steps)} for job in file.jobs)
        return Batch(file.name, str(__version__), key, started or now(), str(path), jobs)


def now() -> str:
    """Return the time in UTC, as `2026-01-31T12:00:00Z`."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def save_batch(runs: Path, batch: Batch) -> None:
    """Write `RUNS/batch.json`."""
    content = {"format": FORMAT, "format_version": VERSION, **asdict(batch)}
    atomic_write_text(runs / BATCH_FILE, json.dumps(content | content.pop("more"), indent=1) + "\n")


def update_batch(runs: Path, **entries: Any) -> None:
    """Add entries to `RUNS/batch.json`, or replace those of the same names; only who holds the batch may."""
    batch = read_batch(runs)
    save_batch(runs, replace(batch, more=batch.more | entries))


def read_batch(runs: Path) -> Batch:
    """Read `RUNS/batch.json`.

    Raises:
        InputError: no batch, or one of another version.
    """
    path = runs / BATCH_FILE
    remedy = "name the folder that the job file calls `out`"
    content = as_object(read_json(path, subject="batch", remedy=remedy), subject=f"batch {path}")
    if content.pop("format", None) != FORMAT or content.pop("format_version", None) != VERSION:
        raise InputError(f"batch {path}", expected=f"{FORMAT}, version {VERSION}", received="another file")
    known = {name: content.pop(name, None) for name in ("name", "version", "code_key", "started", "job_file")}
    texts = {name: as_text(value, subject=f"batch {path}: {name}") for name, value in known.items()}
    jobs = [as_object(job, subject=f"batch {path}: job") for job in as_list(content.pop("jobs", None), subject="jobs")]
    for job in jobs:
        for name in ("subject", "capture"):
            as_text(job.get(name), subject=f"batch {path}: {name}")
        for step in as_list(job.get("steps"), subject=f"batch {path}: steps"):
            require_choice(f"batch {path}: steps", as_text(step, subject=f"batch {path}: step"), tuple(STEPS))
    return Batch(
        texts["name"], texts["version"], texts["code_key"], texts["started"], texts["job_file"], tuple(jobs), content
    )


def save_job(runs: Path, record: JobRecord) -> None:
    """Write `RUNS/SUBJECT/job.json`."""
    atomic_write_text(runs / record.subject / JOB_FILE, json.dumps(asdict(record), indent=1) + "\n")


def read_job(runs: Path, subject: str) -> JobRecord | None:
    """Read `RUNS/SUBJECT/job.json`; None where the subject has not begun.

    Raises:
        InputError: a damaged record.
    """
    path = runs / subject / JOB_FILE
    if not path.exists():
        return None
    where = f"record {path}"
    content = as_object(read_json(path, subject="record"), subject=where)
    steps = []
    for entries in as_list(content.pop("steps", None), subject=where):
        values = as_object(entries, subject=where)
        known = {name: values[name] for name in StepRecord.__dataclass_fields__ if name in values}
        require_plain_fields(StepRecord, known, subject=where)
        if known.get("state") not in get_args(State) or known.get("step") not in STEPS:
            raise InputError(where, expected="steps and states that are known", received=str(known)[:80])
        steps.append(StepRecord(**known))
    texts = {name: as_text(content.get(name, ""), subject=where) for name in ("capture", "state", "note")}
    return JobRecord(subject, texts["capture"], steps, cast(State, texts["state"]), texts["note"])


def records_of(runs: Path, batch: Batch) -> list[JobRecord]:
    """Read the records of all subjects; those that have not begun wait."""
    out = []
    for job in batch.jobs:
        found = read_job(runs, job["subject"])
        steps = [StepRecord(step) for step in job["steps"]]
        out.append(found or JobRecord(job["subject"], job["capture"], steps))
    return out


def proofs_of(folder: Path, job: Job, step: str) -> dict[str, str]:
    """Return the SHA-256 of the files that prove that a step stands, by their paths in the subject's folder.

    A stage's manifest has the digests of its files, so that the manifests stand for all that a command made.
    """
    kind = STEPS[step]
    names = [f"{RUN_FOLDER}/{stage}/manifest.json" for stage in kind.stages]
    names += [name.replace("{subject}", job.subject) for name in kind.files]
    found = {}
    for name in names:
        try:
            found[name] = sha256_file(regular_file(folder / name))
        except InputError:  # a chain has some of the stages, as one without loose clothes
            continue
    return found


def asked_of(job: Job, step: str) -> str:
    """Return a step's command as the job asks for it, without the places of RUNS and scratch."""
    return " ".join(job.command(step, Path(), job.capture))


def stands(folder: Path, job: Job, record: StepRecord) -> bool:
    """Return whether a step is done as its job asks for it, and what proves it is unchanged."""
    if record.state != "done" or record.asked != asked_of(job, record.step):
        return False
    return proofs_of(folder, job, record.step) == record.proofs


def code_key() -> str:
    """Return a digest of the code and the libraries that decide the results of all steps, as their stages' keys do.

    It holds all steps, so that a batch may be given further ones.
    """
    libraries: dict[str, str] = {"python": platform.python_version()}
    for name in TRAINING:
        try:
            libraries |= versions([name])
        except PackageNotFoundError:  # an extra that is not installed: the command will tell
            libraries[name] = "none"
    code = code_of(*dict.fromkeys(kind.module for kind in STEPS.values()))
    return hashlib.sha256(json.dumps([code, libraries], sort_keys=True).encode()).hexdigest()


def current_key() -> str:
    """Return `code_key` of what is installed now, which an upgrade may have replaced since this process began."""
    return _key_at(_stamp())


@cache
def _key_at(stamp: str) -> str:
    if stamp == _BEGAN_WITH:
        return code_key()
    # Digests of sources are kept for the life of a process, so that another one has to look.
    words = "from pipelines.batch.records import code_key; print(code_key())"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=False)
    return done.stdout.strip() or "none"


def _stamp() -> str:
    """Return a text that changes when a source file of the packages does: cheap enough to ask before each command."""
    root = Path(__file__).resolve().parents[2]
    files = (path.stat() for package in PACKAGES for path in (root / package).rglob("*.py"))
    return str(sorted((facts.st_mtime_ns, facts.st_size) for facts in files))


_BEGAN_WITH = _stamp()
