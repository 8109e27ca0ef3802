"""Run folders: one folder a stage, skipped while its configuration, inputs and version stand.

A stage lies in `RUN/<NN_stage>/` with a `manifest.json`. It is written to a temporary folder and renamed, so a kill at
any moment loses at most the stage under way.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.runs.checks import Check
from pipelines.runs.digests import sha256_file, versions
from smplxpp.core.atomic import atomic_folder
from smplxpp.core.errors import InputError
from smplxpp.core.json_values import jsonable

SCHEMA = 1
log = logging.getLogger(__name__)


@dataclass
class StageOutput:
    """What a stage's function hands back beside the files it wrote into its folder."""

    checks: list[Check] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class StageRecord:
    """A finished stage: its folder and manifest, and whether this call ran it."""

    folder: Path
    manifest: dict[str, Any]
    ran: bool


def stage_key(*, config: Any, inputs: Mapping[str, str]) -> str:
    """The hash by which a finished stage is recognised: configuration, inputs and versions."""
    content = {"schema": SCHEMA, "config": jsonable(config), "inputs": dict(inputs), "versions": versions()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a finished stage, or None where there is none that can be read."""
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) and manifest.get("schema") == SCHEMA else None


def _intact(folder: Path, manifest: dict[str, Any]) -> bool:
    files = manifest.get("files", {})
    return all((folder / name).is_file() and sha256_file(folder / name) == digest for name, digest in files.items())


def run_stage(
    run: Path,
    name: str,
    work: Callable[[Path], StageOutput],
    *,
    config: Any,
    inputs: Mapping[str, str],
    seed: int = 0,
    force: bool = False,
) -> StageRecord:
    """Run `work(folder)` and keep its files as `run/name`, unless the stage already stands.

    Args:
        work: writes its files into the folder it is given and returns checks and numbers.
        config: dataclass or mapping, part of the key.
        inputs: SHA-256 by name of everything the stage reads.
        force: run even if the stage stands.
    """
    folder = Path(run) / name
    key = stage_key(config=config, inputs=inputs)
    manifest = read_manifest(folder)
    if not force and manifest is not None and manifest.get("key") == key and _intact(folder, manifest):
        log.info("%s: stands, skipped", name)
        return StageRecord(folder, manifest, ran=False)
    begin = time.perf_counter()
    with atomic_folder(folder) as temporary:
        output = work(temporary)
        files = {
            p.relative_to(temporary).as_posix(): sha256_file(p) for p in sorted(temporary.rglob("*")) if p.is_file()
        }
        manifest = {
            "schema": SCHEMA,
            "stage": name,
            "key": key,
            "config": jsonable(config),
            "inputs": dict(inputs),
            "versions": versions(),
            "seed": seed,
            "seconds": round(time.perf_counter() - begin, 4),
            "checks": [jsonable(check.as_dict()) for check in output.checks],
            "numbers": jsonable(output.numbers),
            "files": files,
        }
        (temporary / "manifest.json").write_text(json.dumps(manifest, indent=1))
    log.info("%s: %.2f s", name, manifest["seconds"])
    return StageRecord(folder, manifest, ran=True)


def require_stage(run: Path, name: str) -> StageRecord:
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
            remedy="run the build without --from-stage, or from an earlier stage",
        )
    return StageRecord(folder, manifest, ran=False)
