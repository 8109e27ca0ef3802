"""Measure a row of the ablation on the model that its player file holds, and put rows into a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avatar.evaluation.evaluate import Evaluation, EvaluationConfig, evaluate_models
from avatar.evaluation.input_protocol import InputProtocol
from avatar.evaluation.protocol import SETS, AsNew
from avatar.evaluation.report import PASSES, SURFACE_SETS, EvalReport, view_key
from avatar.evaluation.summary import garments, summary_figures
from avatar.evaluation.tables import Column, FigureTable
from avatar.rig.rig import AvatarModel
from pipelines.ablation.rows import Row
from pipelines.runs.code import TRAINING
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import ABLATION
from pipelines.runs.stage import MANIFEST, Stage, StageOutput, StageRecord, decide, run_stage
from pipelines.stages.cloth import ClothStage, clothed_sequence
from pipelines.stages.evaluate_inputs import measuring_digests, of_held_out_poses, refined_digest, refined_poses
from pipelines.stages.models import CLOTHED, ModelStage, Trainer
from smplxpp.capture import Capture
from smplxpp.core import ProgressCallback, ignore_progress
from smplxpp.core.files import as_integer, as_number, atomic_write_bytes
from smplxpp.figures import encode_png

ROWS_FOLDER = f"{ABLATION}/rows"
PLAYER_FILE, REPORT_FILE, PICTURES = "player.safetensors", "report.json", "pictures"
TIMED = ("seconds_of_steps", "seconds_of_tracking", "seconds_of_pretraining")


@dataclass(frozen=True)
class RowResult:
    """A trained and measured row.

    Attributes:
        row: definition of the row.
        report: figures of its one model, named by the row's title.
        folder: folder of its pictures.
        seconds: time of training steps, over all of its stages.
        iterations: number of iterations, over all of its stages.
    """

    row: Row
    report: EvalReport
    folder: Path
    seconds: float
    iterations: int


def closure(stage: ModelStage) -> list[ModelStage]:
    """Return the stages that a stage is made from, each once, and the stage at the end."""

    def walk(one: ModelStage) -> Iterator[ModelStage]:
        for needed in one.needs.values():
            yield from walk(needed)
        yield one

    return list({found.name: found for found in walk(stage)}.values())


def row_stage(
    trainer: Trainer, name: str, row: Row, model: ModelStage, config: EvaluationConfig, refined: Capture | None
) -> Stage:
    """Return the stage of a trained row's figures; `refined` is the capture with refined held-out poses."""
    trained = trainer.path(model)
    record = trainer.found(model)
    assert record is not None
    return Stage(
        # The key holds all that the figures depend on: the trained model, the true surfaces that are measured
        # against, the refined held-out poses, and the code of evaluation and stage.
        name=f"{ROWS_FOLDER}/{name}",
        config={"row": row, "evaluation": config, "device": trainer.device, "scale": trainer.scale},
        inputs={
            **trainer.scene.digests,
            "model": record.manifest["files"][model.file],
            **measuring_digests(trainer.scene.capture, config),
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
    """Measure a row unless it is finished; None if it is not and no time is left.

    Args:
        known: protocol of the inputs, for the report.
        in_time: whether there is time left.
    """
    again = refined_poses(trainer.run, trainer.scene.capture)
    stage = row_stage(trainer, name, row, model, config, again)
    simulated = next((one for one in closure(model) if isinstance(one, ClothStage)), None)
    if decide(trainer.run, stage, force=force) != "skip" and not in_time:
        return None

    def work(folder: Path) -> StageOutput:
        # Measure what a player would read, compression included, and not the model in memory.
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
        # Where the run has refined held-out poses, novel poses are measured in them too.
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
    """Return a trainer of the same run whose capture has other poses."""
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


NOVEL_POSE = "novel_pose"
REFINED = "refined."
"""Prefix of the figures in held-out poses that were refined on training cameras."""


@dataclass(frozen=True)
class AblationResult:
    """Finished rows of an ablation, in the order of the table.

    Attributes:
        rows: results by the row's name.
    """

    rows: dict[str, RowResult]

    @property
    def report(self) -> EvalReport:
        """Return one report with the models of all rows."""
        reports = [one.report for one in self.rows.values()]
        models = {title: model for report in reports for title, model in report.models.items()}
        alone = next((report.skinning_alone for report in reports if report.skinning_alone), {})
        conventions = {name: text for report in reports for name, text in report.conventions.items()}
        refined = {title: model for report in reports for title, model in report.refined_poses.items()}
        first = reports[0]
        return EvalReport(
            first.capture, first.metric, models, alone, conventions, first.inputs, refined, lpips=first.lpips
        )


def ablation_table(result: AblationResult) -> FigureTable:
    """Return a table of a line a row: novel views, novel poses, distances to the true surface, bytes, training time."""
    # Columns only for the image sets that some row has; the order is that of the paper's tables.
    metric, capture = (result.report.metric or "", result.report.capture) if result.rows else ("", "")
    lpips = (result.report.lpips if result.rows else None) or ""
    shown = [
        name
        for name in SETS
        if any(name in one.views for r in result.rows.values() for one in r.report.models.values())
    ]
    parts = garments(result.report) if result.rows else ()
    columns = []
    for name in shown:
        columns += [
            Column(f"{name}.psnr", "PSNR", SETS[name], 2, "higher"),
            Column(f"{name}.ssim", "SSIM", SETS[name], 4, "higher"),
            Column(f"{name}.perceptual", metric, SETS[name], 4, "lower"),
            Column(f"{name}.lpips", lpips, SETS[name], 4, "lower"),
        ]
    if any(r.report.refined_poses for r in result.rows.values()):
        group = f"{SETS[NOVEL_POSE]}{PASSES['refined_poses']}"
        columns += [
            Column(f"{REFINED}{NOVEL_POSE}.psnr", "PSNR", group, 2, "higher"),
            Column(f"{REFINED}{NOVEL_POSE}.perceptual", metric, group, 4, "lower"),
        ]
    for name, title in SURFACE_SETS.items():
        group = f"{title}, mm"
        columns += [
            Column(f"surface.{name}.p2s", "P2S", group, 2, "lower"),
            Column(f"surface.{name}.chamfer", "Chamfer", group, 2, "lower"),
        ]
        columns += [Column(f"surface.{name}.{part}.p2s", f"P2S {part}", group, 2, "lower") for part in parts]
    columns += [Column("megabytes", "MB", "", 1, "lower"), Column("minutes", "min", "training", 1)]
    rows = {one.row.title: row_figures(one) for one in result.rows.values()}
    return FigureTable(tuple(columns), rows, _caption(result, capture), row_title="")


def _caption(result: AblationResult, capture: str) -> str:
    if not result.rows:
        return ""
    known = result.report.inputs
    return known.caption(f"ablation on {capture}; {known.sentence()}")


def row_figures(result: RowResult) -> dict[str, float | None]:
    """Return every mean figure of a row, see `summary_figures`, with `minutes` and `iterations` of training.

    Names of figures in refined poses begin with `REFINED`.
    """
    figures = summary_figures(result.report.models[result.row.title])
    again = result.report.refined_poses.get(result.row.title)
    if again is not None:
        views = summary_figures(replace(again, surfaces={}))
        figures |= {f"{REFINED}{key}": value for key, value in views.items() if key.split(".")[0] in again.views}
    return {**figures, "minutes": result.seconds / 60.0, "iterations": float(result.iterations)}
