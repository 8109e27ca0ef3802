"""The build: stages in order, each skipped while it stands, then `metrics.json` and the report."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from pipelines.runs.digests import code_digest, sha256_file
from pipelines.runs.lock import own_run_folder
from pipelines.runs.stage import StageOutput, StageRecord, require_stage, run_stage
from pipelines.stages import scan, template, validate
from pipelines.stages.build_config import STAGES, BuildConfig, BuildInputs, save_build
from smplxpp.body import load_body, load_params
from smplxpp.core.atomic import atomic_write_text
from smplxpp.core.errors import InputError
from smplxpp.core.json_values import jsonable
from smplxpp.segment import find_label_set

log = logging.getLogger(__name__)
METRICS_SCHEMA = 1


@dataclass(frozen=True)
class _Stage:
    """A stage of the build: its work, the stages it reads, the fields of the configuration and inputs it depends on."""

    work: Callable[[Path], StageOutput]
    needs: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


def build(
    run: Path,
    inputs: BuildInputs,
    config: BuildConfig,
    *,
    first: str = STAGES[0],
    last: str = STAGES[-1],
    progress: Callable[[str, bool], None] = lambda name, done: None,
) -> dict[str, StageRecord]:
    """Build a template in the folder `run`.

    Stages before `first` must stand already; stages after `last` are left alone. A stage whose configuration, inputs
    and versions have not changed is not run again.

    Args:
        progress: called with a stage's name before (False) and after (True) it.

    Returns:
        The record of every stage up to `last`.

    Raises:
        InputError: unusable input; every finished stage is kept.
    """
    for name in (first, last):
        if name not in STAGES:
            raise InputError("stage", expected=f"one of {', '.join(STAGES)}", received=repr(name))
    if STAGES.index(first) > STAGES.index(last):
        raise InputError("stages", expected="a first one before the last", received=f"first {first}, last {last}")
    _check_inputs(inputs)
    with own_run_folder(run, (*STAGES, "build", "metrics", "report")):
        save_build(run, inputs, config)
        records = _run_stages(run, inputs, config, STAGES.index(first), STAGES.index(last), progress)
        write_metrics(run, inputs, records)
    return records


def _run_stages(
    run: Path, inputs: BuildInputs, config: BuildConfig, first: int, last: int, progress: Callable[[str, bool], None]
) -> dict[str, StageRecord]:
    stages = _stages(run, inputs, config)
    code = code_digest("smplxpp", "pipelines")
    records: dict[str, StageRecord] = {}
    for k, name in enumerate(STAGES[: last + 1]):
        stage = stages[name]
        if k < first:
            records[name] = require_stage(run, name)
            continue
        progress(name, False)
        settings = {key: getattr(config if hasattr(config, key) else inputs, key) for key in stage.settings}
        digests = {"code": code}
        for key in stage.files:
            digests |= _file_digests(key, getattr(inputs, key))
        for other in stage.needs:
            digests |= {f"{other}/{file}": digest for file, digest in records[other].manifest["files"].items()}
        records[name] = run_stage(run, name, stage.work, config=settings, inputs=digests, seed=config.seed)
        progress(name, True)
    return records


def _stages(run: Path, inputs: BuildInputs, config: BuildConfig) -> dict[str, _Stage]:
    label_files = ("labels", "label_maps", "cameras", "scan")
    geometry = ("00_capture", "10_register", "30_clean")
    return {
        "00_capture": _Stage(
            lambda f: scan.capture(f, inputs, config), (), ("units", "up", "frame"), ("scan", "params", "body")
        ),
        "10_register": _Stage(lambda f: scan.register(f, run, inputs), ("00_capture",), files=("body",)),
        "20_segment": _Stage(lambda f: scan.segment(f, run, inputs), ("00_capture",), ("label_set",), label_files),
        "30_clean": _Stage(lambda f: scan.clean(f, run, config), ("00_capture", "20_segment"), ("budgets",)),
        "40_transfer": _Stage(
            lambda f: template.transfer(f, run, inputs, config),
            geometry[1:],
            ("max_influences", "method", "webs"),
            ("body",),
        ),
        "50_unpose": _Stage(
            lambda f: template.unpose_parts(f, run, inputs), ("10_register", "40_transfer"), files=("body",)
        ),
        "60_assemble": _Stage(
            lambda f: template.assemble(f, run, inputs, config),
            ("00_capture", "10_register", "20_segment", "40_transfer", "50_unpose"),
            ("clearance_mm",),
            ("body",),
        ),
        "65_validate": _Stage(
            lambda f: validate.validate(f, run, inputs, config),
            ("00_capture", "20_segment", "40_transfer", "60_assemble"),
            ("samples", "seed"),
            ("body", "motion"),
        ),
    }


def write_metrics(run: Path, inputs: BuildInputs, records: dict[str, StageRecord]) -> Path:
    """`metrics.json`: every check and number of the finished stages."""
    content: dict[str, Any] = {
        "schema": METRICS_SCHEMA,
        "subject": inputs.subject,
        "checks": [{"stage": name, **check} for name, r in records.items() for check in r.manifest["checks"]],
        "stages": {name: r.manifest["numbers"] for name, r in records.items()},
        "seconds": {name: r.manifest["seconds"] for name, r in records.items()},
    }
    path = run / "metrics.json"
    atomic_write_text(path, json.dumps(jsonable(content), indent=1) + "\n")
    return path


def _check_inputs(inputs: BuildInputs) -> None:
    """What can be known before the first stage starts: files that are missing, and those only the last stages read."""
    for name in ("scan", "params", "labels", "cameras", "motion", "body"):
        path = getattr(inputs, name)
        if path is not None and not Path(path).exists():
            raise InputError(f"option {name}", expected="an existing file", received=str(path))
    if inputs.label_maps and inputs.cameras is None:
        raise InputError(
            "label maps",
            expected="a camera file with them",
            received="none",
            remedy="put cameras.json or calibration.csv into the capture",
        )
    find_label_set(inputs.label_set)
    if inputs.motion is not None:
        load_params(inputs.motion, body=load_body(inputs.body))


def _file_digests(name: str, value: Any) -> dict[str, str]:
    """SHA-256 of an input file, of each file of a folder, or of each of several files; the open body for no body."""
    if value is None:
        if name != "body":
            return {}
        with resources.as_file(resources.files("smplxpp") / "data" / "open_body.npz") as embedded:
            return {name: sha256_file(embedded)}
    if isinstance(value, dict):
        return {f"{name}/{key}": sha256_file(path) for key, path in sorted(value.items())}
    path = Path(value)
    if path.is_dir():
        return {f"{name}/{p.name}": sha256_file(p) for p in sorted(path.iterdir()) if p.is_file()}
    return {name: sha256_file(path)}
