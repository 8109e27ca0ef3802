"""Train the rows of an ablation as stages in `RUN/ablation/`, measure them, and write one table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from avatar.evaluation.evaluate import EvaluationConfig
from avatar.evaluation.tables import FigureTable
from avatar.losses.perceptual_weights import load_metric
from avatar.training.engine.loop import Progress
from avatar.training.engine.processes import Distributed
from avatar.training.presets import TrainingPreset
from pipelines.ablation.measure import PICTURES, AblationResult, ablation_table, closure, measure_row, row_figures
from pipelines.ablation.rows import Row, ablation_stages
from pipelines.runs.layout import ABLATION
from pipelines.stages.evaluate_inputs import input_protocol
from pipelines.stages.models import CLOTHED, Bar, ModelStage, Trainer, TrainOptions
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.capture import Capture
from smplxpp.core.errors import ProgressCallback, ignore_progress
from smplxpp.core.files import atomic_write_bytes, atomic_write_text, jsonable
from smplxpp.core.files.image_file import open_image
from smplxpp.figures import caption, contact_sheet, encode_png

RESULTS_FILE = "results.json"
COLUMNS = 7
"""Pictures in a line of a sheet; all rows in one line would need scrolling."""


@dataclass(frozen=True, eq=False)
class AblationRun:
    """How an ablation runs; no field changes a figure.

    Attributes:
        command: the command line, for `results.json`.
        device: "cpu" or "cuda".
        max_seconds: limit of this call.
        force: train the rows' stages again.
        training: called with the name of a stage and its progress.
        measuring: called with the name of a row and the share of its frames that are measured.
    """

    command: str = ""
    device: str = "cpu"
    max_seconds: float = math.inf
    force: bool = False
    training: Callable[[str, Progress], None] = lambda name, progress: None
    measuring: ProgressCallback = ignore_progress


@dataclass(frozen=True)
class AblationOutcome:
    """Result of a call of `ablate`.

    Attributes:
        folder: `RUN/ablation`.
        table: figures of the finished rows.
        results: content of `results.json`.
        waiting: stages still to be trained, then rows still to be measured; empty when all are finished.
    """

    folder: Path
    table: FigureTable
    results: dict[str, Any]
    waiting: list[str] = field(default_factory=list)


def _report_row(how: AblationRun, row: str, step: str, share: float) -> None:
    """Report how far the measurement of a row is, under the row's name."""
    how.measuring(row, share)


def ablate(
    run: Path,
    inputs: TrainInputs,
    rows: Mapping[str, Row],
    preset: TrainingPreset,
    config: EvaluationConfig,
    how: AblationRun | None = None,
) -> AblationOutcome:
    """Train and measure rows on a capture with a run's template, as far as time allows; finished stages are kept.

    The full system comes first, because most rows share its stages.

    Raises:
        InputError: no template, or a capture that cannot be trained or measured on.
    """
    # Open the capture and the metric once; all rows use the same frames, cameras and measuring protocol.
    how = how or AblationRun()
    scene = open_scene(run, inputs)
    config = _measured(config, scene.capture)
    weights = (preset.teacher.weights, preset.bake.weights, preset.compensate.weights)
    learned = (
        ("st-lpips" if config.metric == "both" else config.metric) if any(w.perceptual for w in weights) else "none"
    )
    perceptual = load_metric(learned, device=how.device, weights=config.lpips_weights)
    options = TrainOptions(max_seconds=how.max_seconds, bar=_bar(how))
    trainer = Trainer(run, scene, options, Distributed(device=how.device), scale=inputs.scale, perceptual=perceptual)
    stages = ablation_stages(preset, training_frames=len(trainer.sequence(CLOTHED).train_frames))
    own = trainer.sequence(CLOTHED)
    known = replace(
        input_protocol(run, scene.capture),
        training_frames=len(own.train_frames),
        training_cameras=len(own.train_cameras),
    )
    # A row whose stages are not finished in time waits; its finished stages are kept for the next call.
    made: set[str] = set()
    found: dict[str, Any] = {}
    for name in sorted(rows, key=lambda name: name != "full"):
        model = stages[rows[name].model]
        if not all(_train(trainer, stage, how, made) for stage in closure(model)):
            continue
        measured = measure_row(
            trainer,
            name,
            rows[name],
            model,
            config,
            known=known,
            force=how.force,
            in_time=bool(trainer.seconds_left()),
            progress=partial(_report_row, how, name),
        )
        if measured is not None:
            found[name] = measured
    result = AblationResult({name: found[name] for name in rows if name in found})
    needed = {stage.name: stage for name in rows if name not in found for stage in closure(stages[rows[name].model])}
    untrained = [Path(name).name for name, stage in needed.items() if not _stands(trainer, stage)]
    waiting = list(dict.fromkeys([*untrained, *(name for name in rows if name not in found)]))
    about = {"command": how.command, "preset": preset, "scale": inputs.scale, "device": how.device}
    return _write(run / ABLATION, result, about, waiting)


def _train(trainer: Trainer, stage: ModelStage, how: AblationRun, made: set[str]) -> bool:
    """Run a stage unless it is finished; return whether it is then. `made` holds the stages of this call."""
    again = how.force and stage.name not in made
    if not again and _stands(trainer, stage):
        return True
    if not trainer.seconds_left():
        return False
    made.add(stage.name)
    return trainer.make(stage, force=again).finished


def _stands(trainer: Trainer, stage: ModelStage) -> bool:
    found = trainer.found(stage)
    return found is not None and found.finished


def _bar(how: AblationRun) -> Bar:
    """Return a progress callback that uses a stage's name without its folder."""

    def bar(name: str, total: int) -> AbstractContextManager[Callable[[Progress], None]]:
        return nullcontext(lambda progress: how.training(Path(name).name, progress))

    return bar


def _measured(config: EvaluationConfig, capture: Capture) -> EvaluationConfig:
    """Restrict a protocol to novel views and novel poses if the capture holds some out; else keep every set."""
    splits = capture.splits
    if config.protocol.sets or not splits.novel_view_cameras:
        return config
    sets = ("novel_view", "novel_pose") if splits.novel_pose_frames else ("novel_view",)
    return replace(config, protocol=replace(config.protocol, sets=sets))


def _write(folder: Path, result: AblationResult, about: Mapping[str, Any], waiting: list[str]) -> AblationOutcome:
    """Write table, figures and picture sheets of the finished rows."""
    table = ablation_table(result)
    rows = {
        name: {"title": one.row.title, "note": one.row.note, "figures": row_figures(one), "seconds": one.seconds}
        for name, one in result.rows.items()
    }
    results = jsonable(
        {
            **about,
            "rows": rows,
            "waiting": waiting,
            "evaluation": result.report.as_dict() if result.rows else None,
        }
    )
    # Tables and pictures of an earlier run may have other rows, so all of them are made again.
    for stale in (*folder.glob("table.*"), *(folder / PICTURES).glob("*.png")):
        stale.unlink()
    if result.rows:
        for suffix, text in (("txt", table.text()), ("csv", table.csv()), ("tex", table.latex(label="tab:ablation"))):
            atomic_write_text(folder / f"table.{suffix}", text)
        _write_sheets(folder, result)
    # The results come last: a folder with them has the tables and pictures that belong to them.
    atomic_write_text(folder / RESULTS_FILE, json.dumps(results, indent=1))
    return AblationOutcome(folder, table, results, waiting)


def _write_sheets(folder: Path, result: AblationResult) -> None:
    """Write a sheet for each view: the photograph, then the picture of each row, with titles."""
    first = next(iter(result.rows))
    for path in sorted(result.rows[first].folder.glob("*.png")):
        pictures: list[np.ndarray] = []
        for one in result.rows.values():
            pair = one.folder / path.name
            if not pair.is_file():
                continue
            photograph, rendered = np.split(_read(pair), 2, axis=1)
            if not pictures:
                pictures.append(caption(photograph, "photograph"))
            pictures.append(caption(rendered, one.row.title))
        (folder / PICTURES).mkdir(exist_ok=True)
        atomic_write_bytes(folder / PICTURES / path.name, encode_png(contact_sheet(pictures, columns=COLUMNS, gap=4)))


def _read(path: Path) -> np.ndarray:
    return np.asarray(open_image(path, subject="picture").convert("RGB"))
