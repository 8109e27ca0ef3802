"""Run a stage of a run folder unless it is finished: skip, resume, run or refuse it, and record it once.

A stage is the folder `RUN/<NN_stage>/` with a `manifest.json`. It is written to a temporary folder and renamed, so that
a kill at any moment loses at most the running stage. A long stage keeps its state in `RUN/<NN_stage>_work/`, which is
deleted when the stage is finished.

| state of the folder | action |
|---|---|
| the stage with its key, finished, its files unchanged | skip |
| the stage with its key, stopped before its end, or state with its key | resume |
| state with another key | refuse, because it may hold hours of work and only the user may delete it |
| anything else | run |

The key is a digest of configuration, inputs, code (`pipelines.runs.code`) and versions of libraries.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pipelines.runs.code import GEOMETRY, code_of, sha256_file, versions
from pipelines.runs.folders import SCHEMA, read_record
from smplxpp.core import InputError, StageOutput
from smplxpp.core.files import atomic_folder, atomic_write_text, jsonable

MANIFEST, STATE_RECORD = "manifest.json", "stage.json"
DIFFERENCES_SHOWN = 3
"""Differences of each kind that an error lists."""
_STATE = ("*.safetensors", "*.npz")
"""Files of a work folder that count as work done."""
Decision = Literal["skip", "resume", "redo"]
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """Everything that determines the result of a stage.

    Attributes:
        name: folder in the run, `85_bake` or `ablation/full`; not part of the key.
        config: dataclass or mapping of every choice.
        inputs: SHA-256 by name of everything that it reads.
        code: modules that do its work; their imports are followed.
        libraries: libraries whose versions affect the result.
        seed: seed of its random numbers.
        resumable: whether it keeps state in a work folder.
        sources: files of the run by their names in `inputs`, where those differ.
    """

    name: str
    config: Any
    inputs: Mapping[str, str]
    code: tuple[str, ...]
    libraries: Sequence[str] = GEOMETRY
    seed: int = 0
    resumable: bool = False
    sources: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Return the contents of the key as JSON values."""
        return {
            "schema": SCHEMA,
            "config": jsonable(self.config),
            "inputs": dict(self.inputs),
            "code": code_of(*self.code),
            "versions": versions(self.libraries),
        }

    @cached_property
    def key(self) -> str:
        """Return the hash that identifies the stage."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()

    @property
    def recorded(self) -> dict[str, Any]:
        """Return `identity` with file names in the place of input names, as manifests hold it."""
        inputs = {self.sources.get(name, name): digest for name, digest in self.inputs.items()}
        return {**self.identity, "inputs": inputs}

    @property
    def work_name(self) -> str:
        """Return the name of the folder with the state of a running stage."""
        return f"{self.name}_work"


@dataclass(frozen=True)
class StageRecord:
    """A finished or stopped stage in its folder.

    Attributes:
        folder: folder of the stage.
        manifest: content of its `manifest.json`.
        ran: whether this call ran it.
    """

    folder: Path
    manifest: dict[str, Any]
    ran: bool

    @property
    def finished(self) -> bool:
        """Return False for a stage that a limit of time stopped."""
        return is_finished(self.manifest)


def is_finished(manifest: Mapping[str, Any]) -> bool:
    """Return whether a stage came to its end; manifests without this entry did."""
    return bool(manifest.get("numbers", {}).get("finished", True))


def how_to_continue(*, force: bool) -> str:
    """Return the hint for a stage that a limit of time stopped."""
    return "the same command without --force continues" if force else "the same command continues"


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a stage, or None if none of this version can be read."""
    return _record(Path(folder) / MANIFEST)


def standing(folder: Path, stage: Stage) -> StageRecord | None:
    """Return the stage in a folder if its key and files are unchanged, else None; it may be unfinished."""
    manifest = read_manifest(folder)
    if manifest is None or manifest.get("key") != stage.key or not _intact(folder, manifest):
        return None
    return StageRecord(folder, manifest, ran=False)


def decide(run: Path, stage: Stage, *, force: bool = False) -> Decision:
    """Return the action that `run_stage` will take.

    Raises:
        InputError: the state of a running stage has another configuration, other inputs or other code.
    """
    if force:
        return "redo"
    found = standing(run / stage.name, stage)
    work = run / stage.work_name
    record = _record(work / STATE_RECORD) or {}
    own = record.get("key") == stage.key
    begun = any(any(work.rglob(pattern)) for pattern in _STATE)
    # A forced training that was killed resumes, although the finished stage that it replaces is still there.
    if own and begun and record.get("forced"):
        return "resume"
    if found is not None and found.finished:
        return "skip"
    if not begun:
        return "redo" if found is None else "resume"
    if not own:
        raise InputError(
            f"state of {stage.name} in {work}",
            expected="these options, inputs and code",
            received=f"another one's: {differences(record, stage)}",
            remedy="give the options that it was made with, or take another run folder; to start again, delete it "
            "(--force does)",
        )
    return "resume"


def run_stage(run: Path, stage: Stage, work: Callable[[Path], StageOutput], *, force: bool = False) -> StageRecord:
    """Run `work(folder)` and keep its files as `run/name`, unless the stage is finished.

    Args:
        run: folder of the run.
        stage: everything that determines the result.
        work: writes files into the given folder and returns checks and numbers. A resumable stage finds its state in
            `run/work_name`.
        force: run even a finished stage, and delete the state of a running one.

    Raises:
        InputError: see `decide`.
    """
    run = Path(run)
    folder, state = run / stage.name, run / stage.work_name
    decision = decide(run, stage, force=force)
    if decision == "skip":
        log.info("%s: finished, skipped", stage.name)
        if (_record(state / STATE_RECORD) or {}).get("key") == stage.key:
            shutil.rmtree(state, ignore_errors=True)
        elif state.is_dir():
            log.warning("%s holds the state of another training, which is kept; delete it if it is of no use", state)
        return StageRecord(folder, read_manifest(folder) or {}, ran=False)
    if decision == "redo":
        shutil.rmtree(state, ignore_errors=True)
    if stage.resumable:
        _warn_of_replacement(folder, stage)
        begin_state(run, stage, force=force)
    # The folder appears whole, with the manifest as its last file.
    begin, own = time.perf_counter(), time.process_time()
    with atomic_folder(folder) as temporary:
        output = work(temporary)
        manifest = _manifest(stage, output, temporary, time.perf_counter() - begin)
        manifest["core_seconds"] = round(time.process_time() - own, 4)
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1))
    if is_finished(manifest):
        shutil.rmtree(state, ignore_errors=True)
    log.info("%s: %.2f s", stage.name, manifest["seconds"])
    return StageRecord(folder, manifest, ran=True)


def begin_state(run: Path, stage: Stage, *, force: bool = False) -> Path:
    """Make the folder of a stage's state, and return it.

    Its record is written before any work, so that the state of a killed stage can be told from another one's.
    """
    state = run / stage.work_name
    forced = force or bool((_record(state / STATE_RECORD) or {}).get("forced"))
    state.mkdir(parents=True, exist_ok=True)
    record = {"key": stage.key, "forced": forced, **stage.recorded}
    atomic_write_text(state / STATE_RECORD, json.dumps(record, indent=1))
    return state


def _warn_of_replacement(folder: Path, stage: Stage) -> None:
    """Log how a finished training that this one will replace differs from it."""
    old = read_manifest(folder)
    if old is not None and is_finished(old) and old.get("key") != stage.key:
        log.warning("%s is trained again and replaces a different one: %s", stage.name, differences(old, stage))


def require_stage(
    run: Path, name: str, *, remedy: str = "run the build without --from-stage, or from an earlier stage"
) -> StageRecord:
    """Return a stage that must already be finished.

    Raises:
        InputError: the stage is missing or its files have changed.
    """
    folder = Path(run) / name
    manifest = read_manifest(folder)
    if manifest is None or not _intact(folder, manifest):
        raise InputError(
            f"stage {name} of {run}",
            expected="a finished stage with its files unchanged",
            received="none" if manifest is None else "changed or missing files",
            remedy=remedy,
        )
    return StageRecord(folder, manifest, ran=False)


def differences(record: Mapping[str, Any], stage: Stage) -> str:
    """Describe how a record differs from a stage: options with both values; inputs, modules and libraries by name."""
    notes = []
    for part in ("config", "inputs", "code", "versions"):
        old, new = (_leaves(one.get(part, {})) for one in (record, stage.recorded))
        changed = [name for name in dict.fromkeys([*old, *new]) if old.get(name) != new.get(name)]
        for name in changed[:DIFFERENCES_SHOWN]:
            values = f" was {old.get(name)}, is {new.get(name)}" if part in ("config", "versions") else ""
            notes.append(f"{part} {name}{values}")
        if len(changed) > DIFFERENCES_SHOWN:
            notes.append(f"{len(changed) - DIFFERENCES_SHOWN} more of {part}")
    return "; ".join(notes) or "its record is missing"


def _leaves(value: Any, name: str = "") -> dict[str, Any]:
    """Return the values of nested mappings by their dotted names."""
    if isinstance(value, Mapping) and value:
        return {k: v for key, one in value.items() for k, v in _leaves(one, f"{name}.{key}" if name else key).items()}
    return {name: value}


def _manifest(stage: Stage, output: StageOutput, folder: Path, seconds: float) -> dict[str, Any]:
    files = {p.relative_to(folder).as_posix(): sha256_file(p) for p in sorted(folder.rglob("*")) if p.is_file()}
    return {
        "stage": stage.name,
        "key": stage.key,
        **stage.recorded,
        "seed": stage.seed,
        "seconds": round(seconds, 4),
        "checks": [jsonable(check.as_dict()) for check in output.checks],
        "numbers": jsonable(output.numbers),
        "files": files,
    }


def _record(path: Path) -> dict[str, Any] | None:
    try:
        return read_record(path)
    except InputError:
        return None


def _intact(folder: Path, manifest: Mapping[str, Any]) -> bool:
    files = manifest.get("files", {})
    return all((folder / name).is_file() and sha256_file(folder / name) == digest for name, digest in files.items())
