"""A row of the ablation is measured: a stage whose model is what a player's file holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avatar.evaluation.as_new import AsNew
from avatar.evaluation.evaluate import Evaluation, EvaluationConfig, evaluate_models
from avatar.evaluation.input_protocol import InputProtocol
from avatar.evaluation.report import EvalReport, view_key
from avatar.rig.posed import AvatarModel
from pipelines.ablation.rows import Row
from pipelines.figures import encode_png
from pipelines.runs.code import TRAINING
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import ABLATION
from pipelines.runs.stage import MANIFEST, Stage, StageOutput, StageRecord, decide, run_stage
from pipelines.stages.cloth import ClothStage, clothed_sequence
from pipelines.stages.evaluate import surface_digest
from pipelines.stages.evaluate_poses import of_held_out_poses, refined_digest, refined_poses
from pipelines.stages.models import CLOTHED, ModelStage, Trainer
from smplxpp.capture import Capture
from smplxpp.core.errors import ProgressCallback, ignore_progress
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_number

ROWS_FOLDER = f"{ABLATION}/rows"
PLAYER_FILE, REPORT_FILE, PICTURES = "player.safetensors", "report.json", "pictures"
TIMED = ("seconds_of_steps", "seconds_of_tracking", "seconds_of_pretraining")


@dataclass(frozen=True)
class RowResult:
    """A row that was trained and measured.

    Attributes:
        row: what it is. report: of its one model, named by the row's title. folder: of its pictures.
        seconds: of training steps, over all stages that it took. iterations: likewise.
    """

    row: Row
    report: EvalReport
    folder: Path
    seconds: float
    iterations: int


def closure(stage: ModelStage) -> list[ModelStage]:
    """A stage after all that it is made from, each once."""

    def walk(one: ModelStage) -> Iterator[ModelStage]:
        for needed in one.needs.values():
            yield from walk(needed)
        yield one

    return list({found.name: found for found in walk(stage)}.values())


def row_stage(
    trainer: Trainer, name: str, row: Row, model: ModelStage, config: EvaluationConfig, refined: Capture | None
) -> Stage:
    """What decides the figures of a row whose model is trained; `refined`: the capture with refined held-out poses."""
    trained = trainer.path(model)
    record = trainer.found(model)
    assert record is not None
    return Stage(
        name=f"{ROWS_FOLDER}/{name}",
        config={"row": row, "evaluation": config, "device": trainer.device, "scale": trainer.scale},
        inputs={
            **trainer.scene.digests,
            "model": record.manifest["files"][model.file],
            "capture/surfaces": surface_digest(trainer.scene.capture, config.protocol),
            **refined_digest(trainer.run, refined),
        },
        code=(__name__, type(model).__module__),
        libraries=TRAINING,
        seed=config.seed,
        sources={"model": trained.relative_to(trainer.run).as_posix()},
    )


def measure_row(
    trainer: Trainer,
    name: str,
    row: Row,
    model: ModelStage,
    config: EvaluationConfig,
    *,
    known: InputProtocol,
    force: bool = False,
    in_time: bool = True,
    progress: ProgressCallback = ignore_progress,
) -> RowResult | None:
    """Measure a row unless it stands; None where it does not stand and there is no time left for it.

    Args:
        known: what is known of the inputs, for the report. in_time: whether there is time left.
    """
    again = refined_poses(trainer.run, trainer.scene.capture)
    stage = row_stage(trainer, name, row, model, config, again)
    simulated = next((one for one in closure(model) if isinstance(one, ClothStage)), None)
    if decide(trainer.run, stage, force=force) != "skip" and not in_time:
        return None

    def work(folder: Path) -> StageOutput:
        player = folder / PLAYER_FILE
        model.write_player(player, trainer.model(model))
        loaded = model.read_by(trainer, player)
        shown: AvatarModel = AsNew(loaded) if row.null_code else loaded
        evaluation = evaluate_models(
            {row.title: shown},
            clothed_sequence(trainer, CLOTHED, simulated),
            config,
            files={row.title: player},
            progress=progress,
        )
        report = replace(evaluation.report, inputs=known)
        if again is not None and (held_out := of_held_out_poses(config, again)) is not None:
            there = clothed_sequence(_seeing(trainer, again), CLOTHED, simulated)
            refined = evaluate_models({row.title: shown}, there, held_out, progress=progress).report
            report = replace(report, refined_poses=refined.models)
        report.save(folder / REPORT_FILE)
        _keep_pictures(folder / PICTURES, evaluation)
        return StageOutput()

    with own_run_folder(trainer.run / ROWS_FOLDER, (name,)):
        record = run_stage(trainer.run, stage, work, force=force)
    return _result(trainer, row, model, record)


def _seeing(trainer: Trainer, capture: Capture) -> Trainer:
    """The same run, its capture with other poses."""
    scene = replace(trainer.scene, capture=capture)
    return Trainer(trainer.run, scene, trainer.options, trainer.together, scale=trainer.scale)


def _result(trainer: Trainer, row: Row, model: ModelStage, record: StageRecord) -> RowResult:
    seconds, iterations = 0.0, 0
    for stage in closure(model):
        found = trainer.found(stage)
        assert found is not None
        numbers, subject = found.manifest["numbers"], f"file {found.folder / MANIFEST}"
        seconds += sum(as_number(numbers.get(name, 0.0), subject=f"{subject}: {name}") for name in TIMED)
        counts = (numbers.get(name, 0) for name in ("iterations", "iterations_before"))
        iterations += sum(as_integer(count, subject=f"{subject}: iterations") for count in counts)
    report = EvalReport.load(record.folder / REPORT_FILE)
    return RowResult(row, report, record.folder / PICTURES, seconds, iterations)


def _keep_pictures(folder: Path, evaluation: Evaluation) -> None:
    """Write photograph and rendering of every shown view side by side, for the rows' strips."""
    folder.mkdir(parents=True, exist_ok=True)
    for view in evaluation.views:
        (rendered,) = view.rendered.values()
        path = folder / f"{view.set}_{view_key(view.camera, view.frame)}.png"
        atomic_write_bytes(path, encode_png(np.concatenate([view.truth, rendered], axis=1)))
