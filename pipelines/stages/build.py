"""The build: stages in order, each skipped while it stands, then `metrics.json`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from pipelines.runs import layout
from pipelines.runs.code import sha256_file
from pipelines.runs.folders import own_run_folder, take_file
from pipelines.runs.layout import BUILD_STAGES, RECONSTRUCT_STAGE, REGISTER_STAGE
from pipelines.runs.stage import Stage, StageRecord, require_stage, run_stage
from pipelines.stages import template_stages
from pipelines.stages.build_config import BuildConfig, BuildContext, BuildInputs, save_build, stages_of
from pipelines.stages.reconstruct import reconstruct_capture
from pipelines.stages.register_capture import register_capture
from smplxpp.build.config import ReconstructInputs, RegisterInputs, resolved
from smplxpp.build.inputs import check_inputs
from smplxpp.core import InputError, StageOutput, require_choice
from smplxpp.core.files import atomic_write_text, jsonable
from smplxpp.detect import load_detector
from smplxpp.register import read_landmarks
from smplxpp.segment import Corrections

METRICS_SCHEMA = 1
Progress = Callable[[str, bool], None]
"""Called with a stage's name before (False) and after (True) it."""
Report = Callable[[Path, BuildInputs, BuildConfig, dict[str, StageRecord]], object]
"""Writes the page of a run from its inputs, choices and the records of its stages."""


@dataclass(frozen=True)
class _Part:
    """A stage of the build with its inputs and settings.

    Attributes:
        work: `work(folder, build)` writes the stage's files.
        step: module of `smplxpp.build` that computes them; its imports are the stage's code.
        needs: stages that it reads, where the build has them.
        settings: fields of the inputs or the configuration that it depends on.
        files: inputs that it reads.
        by_hand: files that it reads where they lie in the run.
        writers: modules that write its files, beside those of all stages.
    """

    work: Callable[..., StageOutput]
    step: str
    needs: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    by_hand: tuple[str, ...] = ()
    writers: tuple[str, ...] = ()

    @property
    def code(self) -> tuple[str, ...]:
        """The modules that do its work."""
        return (f"smplxpp.build.{self.step}", "pipelines.runs.artefacts", *self.writers)


PARTS: dict[str, _Part] = {
    layout.LOCATE_STAGE: _Part(
        template_stages.locate,
        "locate",
        (RECONSTRUCT_STAGE,),
        settings=("units", "up", "height", "detector", "params_row", "whose"),
        files=("scan", "body", "start"),
        by_hand=(layout.LANDMARKS_FILE,),
    ),
    layout.CAPTURE_STAGE: _Part(
        template_stages.capture,
        "prepare",
        (layout.LOCATE_STAGE, REGISTER_STAGE),
        settings=("units", "up", "height", "frame", "params_row", "whose"),
        files=("scan", "params", "body"),
    ),
    layout.POSE_BODY_STAGE: _Part(template_stages.pose_body, "prepare", (layout.CAPTURE_STAGE,), files=("body",)),
    layout.SEGMENT_STAGE: _Part(
        template_stages.segment,
        "segment",
        (layout.CAPTURE_STAGE,),
        settings=("label_set", "label_source"),
        files=("labels", "label_maps", "cameras", "scan", "body"),
        by_hand=(layout.CORRECTIONS_FILE,),
    ),
    layout.CLEAN_STAGE: _Part(
        template_stages.clean,
        "parts",
        (layout.CAPTURE_STAGE, layout.SEGMENT_STAGE),
        settings=("budgets", "remesh"),
    ),
    layout.TRANSFER_STAGE: _Part(
        template_stages.transfer,
        "parts",
        (layout.POSE_BODY_STAGE, layout.SEGMENT_STAGE, layout.CLEAN_STAGE),
        settings=("max_influences", "method", "bridges", "rules"),
        files=("body",),
        writers=("smplxpp.figures.colors",),
    ),
    layout.UNPOSE_STAGE: _Part(
        template_stages.unpose, "parts", (layout.POSE_BODY_STAGE, layout.TRANSFER_STAGE), files=("body",)
    ),
    layout.ASSEMBLE_STAGE: _Part(
        template_stages.assemble,
        "assemble",
        (
            *(layout.CAPTURE_STAGE, layout.POSE_BODY_STAGE, layout.SEGMENT_STAGE),
            *(layout.CLEAN_STAGE, layout.TRANSFER_STAGE, layout.UNPOSE_STAGE),
        ),
        settings=("clearance_mm", "fill_holes", "texture_size", "texture_layout", "normal_map"),
        files=("body", "scan", "photographs", "cameras"),
        writers=("smplxpp.export.gltf", "smplxpp.export.obj"),
    ),
    layout.VALIDATE_STAGE: _Part(
        template_stages.validate,
        "validate",
        (
            *(REGISTER_STAGE, layout.CAPTURE_STAGE, layout.SEGMENT_STAGE),
            *(layout.TRANSFER_STAGE, layout.ASSEMBLE_STAGE),
        ),
        settings=("samples", "seed"),
        files=("body", "motion", "photographs", "cameras"),
    ),
}
"""The stages that make a template; see `_Part`. Two stages have commands of their own: reconstruct and register."""


def build(
    run: Path,
    inputs: BuildInputs,
    config: BuildConfig,
    *,
    registration: RegisterInputs | None = None,
    reconstruction: ReconstructInputs | None = None,
    by_hand: Mapping[str, Path | None] | None = None,
    first: str = BUILD_STAGES[0],
    last: str = BUILD_STAGES[-1],
    progress: Progress = lambda name, done: None,
    report: Report | None = None,
) -> dict[str, StageRecord]:
    """Build a template in the folder `run`.

    Stages before `first` must stand already; stages after `last` are left alone. A stage whose configuration, inputs,
    code and libraries have not changed is not run again.

    Args:
        run: folder of the run.
        inputs: files to read; they decide which stages make the rest.
        config: choices of the stages.
        registration: inputs of the registration, if the build registers the body.
        reconstruction: inputs of the reconstruction, if the build reconstructs the scan.
        by_hand: the user's landmarks and corrections by their names in a run; they replace the files there.
        first: stage to begin with.
        last: stage to end with.
        progress: called with a stage's name before (False) and after (True) it.
        report: function that writes the page of the run after the last stage. The package of reports imports this one,
            so that the caller passes the function in.

    Returns:
        The record of every stage up to `last`.

    Raises:
        BodyNotFoundError: no person was found in the scan, or none with enough confidence; a picture lies in the run.
        InputError: unusable input; every finished stage is kept.
    """
    # Keep the user's files in the run first, so that they remain there if the build fails. Readers refuse wrong ones
    # before anything is replaced.
    readers: dict[str, Callable[[Path], object]] = {
        layout.LANDMARKS_FILE: read_landmarks,
        layout.CORRECTIONS_FILE: partial(Corrections.load, labels=inputs.labels_used),
    }
    for name, source in (by_hand or {}).items():
        take_file(run, name, source, read=readers[name])
    # Check the range of stages and the inputs before the run folder is touched.
    for name in (first, last):
        require_choice("stage", name, BUILD_STAGES)
    if BUILD_STAGES.index(first) > BUILD_STAGES.index(last):
        raise InputError("stages", expected="a first one before the last", received=f"first {first}, last {last}")
    assert inputs.registers == (registration is not None), "what to register to"
    assert inputs.reconstructs == (reconstruction is not None), "what to reconstruct from"
    config = resolved(config, inputs)
    check_inputs(inputs, config=config)
    # The lock keeps a second process from writing into the run while stages change. `build.json` is written first,
    # because stages and the report of an interrupted build read it.
    with own_run_folder(run, (*BUILD_STAGES, "build", "metrics", "report")):
        save_build(run, inputs, config)
        # These two stages do their own bookkeeping, since commands of their own run them as well.
        makers = {}
        if reconstruction is not None:
            makers[RECONSTRUCT_STAGE] = partial(reconstruct_capture, run, reconstruction)
        if registration is not None:
            makers[REGISTER_STAGE] = partial(register_capture, run, registration)
        records = _run_stages(BuildContext(run, inputs, config), makers, first, last, progress)
        write_metrics(run, inputs, records)
    # The page needs all stages; a partial build leaves the previous page in place.
    if report is not None and last == BUILD_STAGES[-1]:
        progress("report", False)
        report(run, inputs, config, records)
        progress("report", True)
    return records


def _run_stages(
    context: BuildContext,
    makers: Mapping[str, Callable[[], StageRecord]],
    first: str,
    last: str,
    progress: Progress,
) -> dict[str, StageRecord]:
    """Run the stages up to `last` in order; `makers` run those that have commands of their own."""
    records: dict[str, StageRecord] = {}
    wanted = stages_of(context.inputs)
    for name in BUILD_STAGES[: BUILD_STAGES.index(last) + 1]:
        # A stage for something that the user has given does not exist in this build.
        if name not in wanted:
            continue
        # Stages before the first one are only read; a missing one ends the build here.
        if BUILD_STAGES.index(name) < BUILD_STAGES.index(first):
            records[name] = require_stage(context.run, name)
            continue
        progress(name, False)
        if name in makers:
            records[name] = makers[name]()
        else:
            work = partial(PARTS[name].work, build=context)
            # `_stage` needs the records so far, because the digests of earlier outputs are part of the key.
            records[name] = run_stage(context.run, _stage(name, context, records), work)
        progress(name, True)
        # The stage stands, so that landmarks can be placed on its scan; what would be built on it does not begin.
        if name == layout.LOCATE_STAGE:
            template_stages.require_body(context, records[name].manifest["numbers"])
    return records


def _stage(name: str, context: BuildContext, records: dict[str, StageRecord]) -> Stage:
    """Return the identity of a stage: its configuration, digests of its inputs, its code and seed."""
    part, inputs, config = PARTS[name], context.inputs, context.config
    digests: dict[str, str] = {}
    # Digest all that the stage reads: input files, files placed by hand, and outputs of earlier stages. Any change in
    # them changes the key and makes the stage run again.
    for key in part.files:
        digests |= _file_digests(key, getattr(inputs, key))
    if "detector" in part.settings and config.detector is not None:
        # The path of a model does not identify its content.
        identity = load_detector(config.detector).identity
        digests["detector"] = hashlib.sha256(identity.encode()).hexdigest()
    label_set = Path(str(inputs.label_set))
    if "label_set" in part.settings and label_set.is_file():
        digests["label_set"] = sha256_file(label_set)
    digests |= {file: sha256_file(context.run / file) for file in part.by_hand if (context.run / file).exists()}
    for other in (name for name in part.needs if name in records):
        digests |= {f"{other}/{file}": digest for file, digest in records[other].manifest["files"].items()}
    return Stage(
        name=name,
        # Inputs come first: they hold what the choices of the same name have led to.
        config={key: getattr(inputs if hasattr(inputs, key) else config, key) for key in part.settings},
        inputs=digests,
        code=part.code,
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
    path = run / layout.METRICS_FILE
    atomic_write_text(path, json.dumps(jsonable(content), indent=1) + "\n")
    return path


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
