"""The one resumable stage: skipped while it stands, resumed where it was, made anew, or refused; recorded once.

A stage lies in `RUN/<NN_stage>/` with a `manifest.json`. It is written to a temporary folder and renamed, so that a
kill at any moment loses at most the stage under way. A stage that takes long keeps its state in `RUN/<NN_stage>_work/`,
which goes when it is finished.

| what lies there | what is done |
|---|---|
| the stage with its key, finished, its files unchanged | skipped |
| the stage with its key, stopped before its end, or state with its key | resumed |
| state with another key | refused: hours may lie in it, only the user can say that they may go |
| anything else | made anew |

The key is a digest of configuration, inputs, code (`pipelines.runs.code`), versions of libraries.
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
from pipelines.runs.manifest import SCHEMA, read_record
from smplxpp.core.checks import Check
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_folder, atomic_write_text
from smplxpp.core.files.json_file import jsonable

MANIFEST, STATE_RECORD = "manifest.json", "stage.json"
DIFFERENCES_SHOWN = 3
_STATE = ("*.safetensors", "*.npz")
"""Files of a work folder in which hours may lie."""
Decision = Literal["skip", "resume", "redo"]
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """What decides a stage.

    Attributes:
        name: its folder in the run, `85_bake` or `ablation/full`; not part of the key.
        config: dataclass or mapping of every choice.
        inputs: SHA-256 by name of everything that it reads.
        code: modules that do its work; what they import belongs to them.
        libraries: whose versions decide what comes out.
        seed: of what is drawn.
        resumable: it keeps state in a work folder.
        sources: files of the run by the names that `inputs` has for them, where those differ.
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
        """All that the key is made of, as JSON values."""
        return {
            "schema": SCHEMA,
            "config": jsonable(self.config),
            "inputs": dict(self.inputs),
            "code": code_of(*self.code),
            "versions": versions(self.libraries),
        }

    @cached_property
    def key(self) -> str:
        """The hash by which the stage is recognised."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()

    @property
    def recorded(self) -> dict[str, Any]:
        """`identity` with the names of files in the place of those of inputs, as manifests have it."""
        inputs = {self.sources.get(name, name): digest for name, digest in self.inputs.items()}
        return {**self.identity, "inputs": inputs}

    @property
    def work_name(self) -> str:
        """The folder of the state of a stage under way."""
        return f"{self.name}_work"


@dataclass
class StageOutput:
    """What a stage's function hands back beside the files it wrote into its folder."""

    checks: list[Check] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class StageRecord:
    """A stage that stands: its folder and manifest, and whether this call ran it."""

    folder: Path
    manifest: dict[str, Any]
    ran: bool

    @property
    def finished(self) -> bool:
        """False for a stage that a limit of time stopped."""
        return is_finished(self.manifest)


def is_finished(manifest: Mapping[str, Any]) -> bool:
    """Whether a stage came to its end; one that says nothing of it did."""
    return bool(manifest.get("numbers", {}).get("finished", True))


def goes_on(*, force: bool) -> str:
    """What to say of a stage that a limit of time stopped."""
    return "the same command without --force goes on" if force else "the same command goes on"


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a stage, or None where there is none of this version that can be read."""
    return _record(Path(folder) / MANIFEST)


def standing(folder: Path, stage: Stage) -> StageRecord | None:
    """What lies in a folder, if it is this stage with its files unchanged; it may be unfinished."""
    manifest = read_manifest(folder)
    if manifest is None or manifest.get("key") != stage.key or not _intact(folder, manifest):
        return None
    return StageRecord(folder, manifest, ran=False)


def decide(run: Path, stage: Stage, *, force: bool = False) -> Decision:
    """What `run_stage` will do.

    Raises:
        InputError: the state of a stage under way is of another configuration, other inputs or other code.
    """
    if force:
        return "redo"
    found = standing(run / stage.name, stage)
    work = run / stage.work_name
    record = _record(work / STATE_RECORD) or {}
    own = record.get("key") == stage.key
    begun = any(any(work.rglob(pattern)) for pattern in _STATE)
    if own and begun and record.get("forced"):  # a training anew that was killed goes on, whatever it is to replace
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
            remedy="give the options that it was made with, or take another run folder; to start anew, delete it "
            "(--force does)",
        )
    return "resume"


def run_stage(run: Path, stage: Stage, work: Callable[[Path], StageOutput], *, force: bool = False) -> StageRecord:
    """Run `work(folder)` and keep its files as `run/name`, unless the stage already stands.

    Args:
        work: writes its files into the folder it is given and returns checks and numbers. A resumable stage finds its
            state in `run/work_name`.
        force: run even if the stage stands; state of one under way goes.

    Raises:
        InputError: see `decide`.
    """
    run = Path(run)
    folder, state = run / stage.name, run / stage.work_name
    decision = decide(run, stage, force=force)
    if decision == "skip":
        log.info("%s: stands, skipped", stage.name)
        if (_record(state / STATE_RECORD) or {}).get("key") == stage.key:
            shutil.rmtree(state, ignore_errors=True)
        elif state.is_dir():
            log.warning("%s holds the state of another training, which is kept; delete it if it is of no use", state)
        return StageRecord(folder, read_manifest(folder) or {}, ran=False)
    if decision == "redo":
        shutil.rmtree(state, ignore_errors=True)
    if stage.resumable:
        _tell_replaced(folder, stage)
        forced = force or bool((_record(state / STATE_RECORD) or {}).get("forced"))
        state.mkdir(parents=True, exist_ok=True)
        record = {"key": stage.key, "forced": forced, **stage.recorded}
        atomic_write_text(state / STATE_RECORD, json.dumps(record, indent=1))
    begin = time.perf_counter()
    with atomic_folder(folder) as temporary:
        output = work(temporary)
        manifest = _manifest(stage, output, temporary, time.perf_counter() - begin)
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1))
    if is_finished(manifest):
        shutil.rmtree(state, ignore_errors=True)
    log.info("%s: %.2f s", stage.name, manifest["seconds"])
    return StageRecord(folder, manifest, ran=True)


def _tell_replaced(folder: Path, stage: Stage) -> None:
    """Log what a finished training differs in that this one will take the place of."""
    old = read_manifest(folder)
    if old is not None and is_finished(old) and old.get("key") != stage.key:
        log.warning("%s is trained anew and replaces one made otherwise: %s", stage.name, differences(old, stage))


def require_stage(
    run: Path, name: str, *, remedy: str = "run the build without --from-stage, or from an earlier stage"
) -> StageRecord:
    """A stage that must already be there (after `--from`).

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
    """What a record differs in from a stage, in words: options with both values, inputs, modules, libraries by name."""
    words = []
    for part in ("config", "inputs", "code", "versions"):
        old, new = (_leaves(one.get(part, {})) for one in (record, stage.recorded))
        changed = [name for name in dict.fromkeys([*old, *new]) if old.get(name) != new.get(name)]
        for name in changed[:DIFFERENCES_SHOWN]:
            values = f" was {old.get(name)}, is {new.get(name)}" if part in ("config", "versions") else ""
            words.append(f"{part} {name}{values}")
        if len(changed) > DIFFERENCES_SHOWN:
            words.append(f"{len(changed) - DIFFERENCES_SHOWN} more of {part}")
    return "; ".join(words) or "its record is missing"


def _leaves(value: Any, name: str = "") -> dict[str, Any]:
    """The values of nested mappings by their dotted names."""
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
