"""Read a job file: which subjects there are, where their captures lie, which commands run on each, with which options.

    name: spring                    # optional, by default the name of the file
    out: runs/spring                # RUNS, on a file system that all machines share
    results: s3://studio/spring     # optional: where finished folders are copied to
    defaults:
      steps: [check, build, train, evaluate, export]
      build: {texture_size: 1024}   # options of a command, by its names
      train: {preset: gpu}
      resources: {cores: 4, gpus: 1, minutes: 720}
      overrides:                    # for subjects whose names match a pattern
        "dancer_*": {train: {cloth: auto}}
    jobs:
      - {subject: anna, capture: captures/anna}
      - {subject: ben, capture: s3://studio/ben, train: {preset: paper}, accept: [check]}

Relative paths start at the folder of the job file; `{subject}` in an option stands for the subject's name.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pipelines.batch.steps import OF_REFINEMENT, SPLIT, STEPS, Needs
from smplxpp.core.errors import InputError, did_you_mean, require_choice
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text, shown
from smplxpp.core.files.markup_file import read_yaml
from smplxpp.core.files.paths import absolute

DEFAULT_STEPS = ("check", "build", "train", "evaluate", "export")
RESERVED = ("batch.json", "index.html", "index.json", "summary.csv", "stop.json", "cluster")
"""Names in RUNS that no subject may have."""
_SUBJECT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")
_TOP = ("name", "out", "results", "defaults", "jobs")
_OPTIONS = ("steps", "frames", "accept", "resources", *STEPS)


@dataclass(frozen=True)
class Job:
    """A subject and what is to be done with its capture.

    Attributes:
        subject: its name, which is that of its folder in RUNS.
        capture: folder or address of its capture; empty where a build is given a scan.
        steps: names of `STEPS`, in their order.
        options: options of each step's command, by the command's names.
        frames: frames of a chunk, where steps are split into chunks of frames; 0: none is.
        accept: steps whose failed checks do not end the chain.
        needs: what it takes of a machine.
    """

    subject: str
    capture: str
    steps: tuple[str, ...] = DEFAULT_STEPS
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    frames: int = 0
    accept: tuple[str, ...] = ()
    needs: Needs = field(default_factory=Needs)

    @property
    def remote(self) -> bool:
        """Return whether the capture is at an address, from which it has to be copied."""
        return is_address(self.capture)

    def command(self, step: str, folder: Path, capture: str) -> list[str]:
        """Return the words of a step's command, without the program.

        Args:
            step: one of `STEPS`.
            folder: the subject's folder in RUNS.
            capture: where the capture lies on this machine.
        """
        given = self._given(step)
        run = str(given.pop("run", folder / "run"))
        if "convert" in self.steps and step != "convert":
            capture = str(folder / "capture")
        if self.frames and step in SPLIT:
            return self._chunks(step, folder, capture)
        source = [] if "scan" in given else ["--capture", capture]
        # Parameters that chunks were joined to lie beside the run, whose own registration has all frames.
        if self.frames and "register" in self.steps and "params" not in given:
            source += ["--params", str(folder / "register" / "params.npz")]
        places: dict[str, list[str]] = {
            "convert": [capture, "--out", str(folder / "capture")],
            "check": [capture, "--out", str(folder / "check")],
            "reconstruct": [run, "--capture", capture],
            "register": [run, "--capture", capture],
            "metrics": [capture, str(given.get("truth", "")), "--out", str(folder / "metrics.json")],
            "build": [run, *source],
            "refine": [run, *source, "--stage", "refine"],
            "train": [run, *source],
            "evaluate": [run, *source],
            # A student for our players; without a training the rigged template.
            "export": [run, "--out", str(folder / f"{self.subject}.{'avatar' if 'train' in self.steps else 'glb'}")],
            "web": [run, "--single-file", str(folder / "player.html")],
        }
        own = {name.replace("_", "-") for name in given}
        words = places[step]
        if step in ("export", "web") and own & {"out", "solid", "single-file"}:
            words = words[:1]
        given.pop("truth", None)
        return [*STEPS[step].words, *words, *option_words(given, subject=self.subject), "--json"]

    def _given(self, step: str) -> dict[str, Any]:
        """Return the options of a step; a refinement has those of the training that it is for."""
        given = dict(self.options.get(step, {}))
        if step == "refine":
            training = self.options.get("train", {})
            given = {**{name: training[name] for name in OF_REFINEMENT if name in training}, **given}
        # The training takes a refinement in chunks only where it would be split alike.
        if self.frames and "refine" in self.steps and step in ("refine", "train"):
            given.setdefault("refine_frames", self.frames)
        return given

    def _chunks(self, step: str, folder: Path, capture: str) -> list[str]:
        """Return the words of the command that runs a step in chunks of frames and joins them."""
        given = self._given(step)
        if step == "refine":
            given.pop("refine_frames")
            if "register" in self.steps and "params" not in given:
                given["params"] = str(folder / "register" / "params.npz")
        truth = ["--truth", str(given.pop("truth"))] if "truth" in given else []
        if step == "register" and "reconstruct" in self.steps and "scans" not in given:
            given["scans"] = str(folder / "reconstruct" / "scans")
        words = ["batch", "frames", step, str(folder / step), "--capture", capture, *truth]
        words += ["--size", str(self.frames), "--local", str(self.needs.cores or 1)]
        words += ["--into", str(folder / "run")] if step == "refine" else []
        also = []
        for name, value in given.items():
            for one in value if isinstance(value, list) else [value]:
                if one is not None and one is not False:
                    also.append(name if one is True else f"{name}={str(one).replace('{subject}', self.subject)}")
        return [*words, *(["--also", *also] if also else []), "--json"]


@dataclass(frozen=True)
class JobFile:
    """What a job file says.

    Attributes:
        name: of the batch.
        out: RUNS.
        folder: of the job file, at which relative paths start.
        results: address that finished folders are copied to; empty: none.
        jobs: a job a subject.
    """

    name: str
    out: Path
    folder: Path
    results: str
    jobs: tuple[Job, ...]


def read_jobs(path: Path) -> JobFile:
    """Read a job file.

    Raises:
        InputError: the file, an entry or a value cannot be used; the message names the job.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        ...     _ = file.write("out: runs\\njobs: [{subject: anna, capture: anna, steps: [build]}]")
        ...     file.flush()
        ...     batch = read_jobs(Path(file.name))
        >>> batch.jobs[0].command("build", Path("runs/anna"), "anna")
        ['build', 'runs/anna/run', '--capture', 'anna', '--json']
    """
    # A line of a thousand subjects is some hundred bytes long.
    content = as_object(read_yaml(path, subject="job file", most_bytes=16 << 20), subject=f"job file {path}")
    _require_keys(content, _TOP, subject=f"job file {path}")
    folder = absolute(path).parent
    listed = as_list(content.get("jobs", []), subject="jobs")
    if not listed or "out" not in content:
        raise InputError(
            f"job file {path}",
            expected="out: FOLDER and jobs: a list of at least one subject",
            received="no out" if listed else "no jobs",
        )
    # Each job is the defaults, the overrides whose pattern its name matches, and its own entries, in this order.
    defaults = as_object(content.get("defaults") or {}, subject="defaults")
    _require_keys(defaults, (*_OPTIONS, "overrides"), subject="defaults")
    overrides = as_object(defaults.get("overrides") or {}, subject="overrides")
    for pattern, entries in overrides.items():
        _require_keys(as_object(entries, subject=f"overrides {pattern}"), _OPTIONS, subject=f"overrides {pattern}")
    jobs = []
    for number, entries in enumerate(listed, 1):
        own = as_object(entries, subject=f"job {number}")
        _require_keys(own, ("subject", "capture", *_OPTIONS), subject=f"job {number}")
        subject = _subject(own.get("subject"), number)
        layers = [defaults, *(e for pattern, e in overrides.items() if fnmatchcase(subject, pattern)), own]
        jobs.append(_job(subject, own.get("capture"), layers, folder))
    _refuse_shared_folders(jobs)
    out = Path(as_text(content["out"], subject="out"))
    if is_address(str(content["out"])):
        raise InputError(
            "out",
            expected="a folder on a file system that all machines share",
            received=str(content["out"]),
            remedy="name a folder, and the address as results: finished folders are copied there",
        )
    return JobFile(
        name=as_text(content.get("name") or path.stem, subject="name"),
        out=absolute(folder / out),
        folder=folder,
        results=as_text(content.get("results") or "", subject="results"),
        jobs=tuple(jobs),
    )


def is_address(text: str) -> bool:
    """Return whether a text is an address of an object store or a server, as `s3://bucket/anna` is."""
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", text) is not None


def option_words(options: Mapping[str, Any], *, subject: str) -> list[str]:
    """Return options by their names as words of a command line.

    Example:
        >>> option_words({"fit_iterations": 5, "no_teacher": True, "budgets": {"hair": 400}}, subject="anna")
        ['--fit-iterations', '5', '--no-teacher', '--budgets', 'hair', '400']
    """
    words: list[str] = []
    for name, value in options.items():
        # A flag stands alone; null and false take back what the defaults say.
        if value is None or value is False:
            continue
        words.append(f"--{name.replace('_', '-')}")
        if isinstance(value, Mapping):
            words += [str(word) for pair in value.items() for word in pair]
        elif isinstance(value, list):
            words += [str(word) for word in value]
        elif value is not True:
            words.append(str(value).replace("{subject}", subject))
    return words


def _job(subject: str, capture: Any, layers: list[dict[str, Any]], folder: Path) -> Job:
    """Return a job of what its layers say, the later ones first."""
    merged: dict[str, Any] = {}
    options: dict[str, dict[str, Any]] = {step: {} for step in STEPS}
    for layer in layers:
        merged |= {name: value for name, value in layer.items() if name not in STEPS}
        for step in STEPS:
            options[step] |= as_object(layer.get(step) or {}, subject=f"{subject}: {step}")
    steps = _names(merged.get("steps", list(DEFAULT_STEPS)), subject=f"{subject}: steps")
    if not steps:
        raise InputError(f"{subject}: steps", expected=f"some of {', '.join(STEPS)}", received="none")
    # Without a capture a chain can only build a scan, and export what comes out.
    place = "" if capture is None else as_text(capture, subject=f"{subject}: capture")
    alone = set(steps) <= {"build", "export"} and "scan" in options["build"]
    if not place and not alone:
        raise InputError(
            f"{subject}: capture",
            expected="the folder or the address of a capture, or steps [build, export] with build: {scan: FILE}",
            received="none",
        )
    needs = as_object(merged.get("resources") or {}, subject=f"{subject}: resources")
    _require_keys(needs, tuple(Needs.__dataclass_fields__), subject=f"{subject}: resources")
    numbers = {name: as_number(value, subject=f"{subject}: {name}") for name, value in needs.items()}
    if "cores" in needs:
        numbers["cores"] = as_integer(needs["cores"], subject=f"{subject}: cores")
    return Job(
        subject=subject,
        capture=place if not place or is_address(place) else os.path.normpath(folder / place),
        steps=steps,
        options={step: options[step] for step in steps if options[step]},
        frames=as_integer(merged.get("frames") or 0, subject=f"{subject}: frames", least=0),
        accept=_names(merged.get("accept") or [], subject=f"{subject}: accept"),
        needs=Needs(**numbers),  # type: ignore[arg-type]
    )


def _names(value: Any, *, subject: str) -> tuple[str, ...]:
    """Return steps in the order in which they run."""
    names = [as_text(name, subject=subject) for name in as_list(value, subject=subject)]
    for name in names:
        require_choice(subject, name, tuple(STEPS))
    return tuple(step for step in STEPS if step in names)


def _subject(value: Any, number: int) -> str:
    """Return a subject's name if a folder of every file system and an address can have it."""
    name = str(value) if isinstance(value, int) and not isinstance(value, bool) else value
    if not isinstance(name, str) or not _SUBJECT.fullmatch(name) or name.endswith(".") or name.lower() in RESERVED:
        raise InputError(
            f"job {number}: subject",
            expected="a name of at most 80 letters, digits, dots, dashes and underscores, for it names a folder",
            received=shown(value),
            remedy=f"these names are taken: {', '.join(RESERVED)}" if str(value).lower() in RESERVED else "",
        )
    return name


def _refuse_shared_folders(jobs: list[Job]) -> None:
    """Refuse two jobs that write into one folder or file, also where the file system takes ANNA for anna."""
    taken: dict[str, str] = {}
    for number, job in enumerate(jobs, 1):
        written = [job.subject.lower()]
        for step in job.steps:
            for name, value in job.options.get(step, {}).items():
                if name.replace("_", "-") in ("out", "solid", "single-file"):
                    written.append(os.path.normpath(str(value).replace("{subject}", job.subject)))
        for place in written:
            if place in taken:
                raise InputError(
                    f"job {number}, {job.subject}",
                    expected="a folder of its own for each job",
                    received=f"{place}, which {taken[place]} writes, too",
                    remedy="give each subject a name of its own, and write {subject} into the options' paths",
                )
            taken[place] = f"job {number}, {job.subject},"


def _require_keys(content: Mapping[str, Any], known: tuple[str, ...], *, subject: str) -> None:
    """Refuse entries that are not known, with the known one that is written alike."""
    for name in content:
        if name not in known:
            raise InputError(
                subject, expected=f"entries among {', '.join(known)}", received=name, remedy=did_you_mean(name, known)
            )
