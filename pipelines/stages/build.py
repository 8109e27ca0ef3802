"""The build: stages in order, each skipped while it stands, then `metrics.json`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Any

from pipelines.runs.code import sha256_file
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import (
    ASSEMBLE_STAGE,
    BUILD_STAGES,
    CAPTURE_STAGE,
    CLEAN_STAGE,
    CORRECTIONS_FILE,
    LANDMARKS_FILE,
    LOCATE_STAGE,
    METRICS_FILE,
    POSE_BODY_STAGE,
    RECONSTRUCT_STAGE,
    REGISTER_STAGE,
    SEGMENT_STAGE,
    TRANSFER_STAGE,
    UNPOSE_STAGE,
    VALIDATE_STAGE,
)
from pipelines.runs.stage import Stage, StageRecord, require_stage, run_stage
from pipelines.stages import assemble, capture, clean, locate, pose_body, segment, transfer, unpose, validate
from pipelines.stages.build_config import BuildConfig, BuildContext, BuildInputs, save_build
from pipelines.stages.reconstruct import reconstruct_capture
from pipelines.stages.reconstruct_config import ReconstructInputs
from pipelines.stages.register_capture import register_capture
from pipelines.stages.register_config import RegisterInputs
from smplxpp.body import load_body, load_params
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import jsonable
from smplxpp.core.validation import require_choice
from smplxpp.detect import load_detector
from smplxpp.segment import find_label_set

METRICS_SCHEMA = 1


@dataclass(frozen=True)
class _Part:
    """A stage of the build.

    Attributes:
        module: its `run(folder, build)` does the work; its imports are the stage's code.
        needs: stages that it reads, where the build has them.
        settings: fields of the configuration or the inputs that it depends on. files: inputs that it reads.
        by_hand: files that it reads where they lie in the run.
    """

    module: ModuleType
    needs: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    by_hand: tuple[str, ...] = ()


PARTS: dict[str, _Part] = {
    LOCATE_STAGE: _Part(
        locate,
        (RECONSTRUCT_STAGE,),
        settings=("units", "up", "detector"),
        files=("scan", "body"),
        by_hand=(LANDMARKS_FILE,),
    ),
    CAPTURE_STAGE: _Part(
        capture,
        (LOCATE_STAGE, REGISTER_STAGE),
        settings=("units", "up", "frame", "params_row"),
        files=("scan", "params", "body"),
    ),
    POSE_BODY_STAGE: _Part(pose_body, (CAPTURE_STAGE,), files=("body",)),
    SEGMENT_STAGE: _Part(
        segment,
        (CAPTURE_STAGE,),
        settings=("label_set", "label_source"),
        files=("labels", "label_maps", "cameras", "scan", "body"),
        by_hand=(CORRECTIONS_FILE,),
    ),
    CLEAN_STAGE: _Part(clean, (CAPTURE_STAGE, SEGMENT_STAGE), settings=("budgets", "remesh")),
    TRANSFER_STAGE: _Part(
        transfer, (POSE_BODY_STAGE, CLEAN_STAGE), settings=("max_influences", "method", "webs"), files=("body",)
    ),
    UNPOSE_STAGE: _Part(unpose, (POSE_BODY_STAGE, TRANSFER_STAGE), files=("body",)),
    ASSEMBLE_STAGE: _Part(
        assemble,
        (CAPTURE_STAGE, POSE_BODY_STAGE, SEGMENT_STAGE, CLEAN_STAGE, TRANSFER_STAGE, UNPOSE_STAGE),
        settings=("clearance_mm", "darning"),
        files=("body",),
    ),
    VALIDATE_STAGE: _Part(
        validate,
        (REGISTER_STAGE, CAPTURE_STAGE, SEGMENT_STAGE, TRANSFER_STAGE, ASSEMBLE_STAGE),
        settings=("samples", "seed"),
        files=("body", "motion", "photographs", "cameras"),
    ),
}


def build(
    run: Path,
    inputs: BuildInputs,
    config: BuildConfig,
    *,
    registration: RegisterInputs | None = None,
    reconstruction: ReconstructInputs | None = None,
    first: str = BUILD_STAGES[0],
    last: str = BUILD_STAGES[-1],
    progress: Callable[[str, bool], None] = lambda name, done: None,
) -> dict[str, StageRecord]:
    """Build a template in the folder `run`.

    Stages before `first` must stand already; stages after `last` are left alone. A stage whose configuration, inputs,
    code and libraries have not changed is not run again.

    Args:
        registration: what the body is registered to, where the inputs say that it is. reconstruction: what the scan is
            made of, where they say that.
        progress: called with a stage's name before (False) and after (True) it.

    Returns:
        The record of every stage up to `last`.

    Raises:
        InputError: unusable input; every finished stage is kept.
    """
    for name in (first, last):
        require_choice("stage", name, BUILD_STAGES)
    if BUILD_STAGES.index(first) > BUILD_STAGES.index(last):
        raise InputError("stages", expected="a first one before the last", received=f"first {first}, last {last}")
    assert (REGISTER_STAGE in inputs.stages) == (registration is not None), "what to register to"
    assert inputs.reconstructs == (reconstruction is not None), "what to reconstruct from"
    _check_inputs(inputs)
    with own_run_folder(run, (*BUILD_STAGES, "build", "metrics", "report")):
        save_build(run, inputs, config)
        makers = {}
        if reconstruction is not None:
            makers[RECONSTRUCT_STAGE] = partial(reconstruct_capture, run, reconstruction)
        if registration is not None:
            makers[REGISTER_STAGE] = partial(register_capture, run, registration)
        records = _run_stages(BuildContext(run, inputs, config), makers, first, last, progress)
        write_metrics(run, inputs, records)
    return records


def _run_stages(
    context: BuildContext,
    makers: Mapping[str, Callable[[], StageRecord]],
    first: str,
    last: str,
    progress: Callable[[str, bool], None],
) -> dict[str, StageRecord]:
    """Run stages one after the other; those of `makers` have commands of their own."""
    records: dict[str, StageRecord] = {}
    for name in BUILD_STAGES[: BUILD_STAGES.index(last) + 1]:
        if name not in context.inputs.stages:
            continue
        if BUILD_STAGES.index(name) < BUILD_STAGES.index(first):
            records[name] = require_stage(context.run, name)
            continue
        progress(name, False)
        if name in makers:
            records[name] = makers[name]()
        else:
            stage, module = _stage(name, context, records), PARTS[name].module
            records[name] = run_stage(context.run, stage, partial(module.run, build=context))
        progress(name, True)
    return records


def _stage(name: str, context: BuildContext, records: dict[str, StageRecord]) -> Stage:
    """What decides a stage of the build."""
    part, inputs, config = PARTS[name], context.inputs, context.config
    digests: dict[str, str] = {}
    for key in part.files:
        digests |= _file_digests(key, getattr(inputs, key))
    if "detector" in part.settings and config.detector is not None:
        # The path of a model says nothing of what is in it.
        identity = load_detector(config.detector).identity
        digests["detector"] = hashlib.sha256(identity.encode()).hexdigest()
    digests |= {file: sha256_file(context.run / file) for file in part.by_hand if (context.run / file).exists()}
    for other in (name for name in part.needs if name in records):
        digests |= {f"{other}/{file}": digest for file, digest in records[other].manifest["files"].items()}
    return Stage(
        name=name,
        config={key: getattr(config if hasattr(config, key) else inputs, key) for key in part.settings},
        inputs=digests,
        code=(part.module.__name__,),
        seed=config.seed,
    )


def write_metrics(run: Path, inputs: BuildInputs, records: dict[str, StageRecord]) -> Path:
    """Write `metrics.json`: every check and number of the finished stages."""
    checks = [{"stage": name, **check} for name, record in records.items() for check in record.manifest["checks"]]
    content = {
        "schema": METRICS_SCHEMA,
        "subject": inputs.subject,
        "checks": checks,
        "stages": {name: record.manifest["numbers"] for name, record in records.items()},
        "seconds": {name: record.manifest["seconds"] for name, record in records.items()},
    }
    path = run / METRICS_FILE
    atomic_write_text(path, json.dumps(jsonable(content), indent=1) + "\n")
    return path


def _check_inputs(inputs: BuildInputs) -> None:
    """What can be known before the first stage starts: files that are missing, and those only the last stages read."""
    for name in ("scan", "params", "labels", "cameras", "motion", "body"):
        path = None if name == "scan" and inputs.reconstructs else getattr(inputs, name)
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
