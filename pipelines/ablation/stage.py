"""The ablation of a run: `RUN/ablation/` with a folder a trained piece, the table, and the rows beside each other."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from avatar.evaluation.evaluate import Evaluation, EvaluationConfig
from avatar.evaluation.report import view_key
from avatar.evaluation.tables import FigureTable
from avatar.losses.perceptual import load_metric
from avatar.training.engine.loop import Progress
from avatar.training.presets import TrainingPreset
from pipelines.ablation.adopt import adopt_trained
from pipelines.ablation.pieces import CLOTHED, Workshop
from pipelines.ablation.rows import Row, ablation_pieces
from pipelines.ablation.run import (
    ROWS_FOLDER,
    Ablation,
    AblationResult,
    Observer,
    ablation_table,
    row_figures,
    unfinished,
)
from pipelines.figures import caption, encode_png, row
from pipelines.runs.lock import own_run_folder
from pipelines.stages.train_inputs import TrainInputs, open_scene
from smplxpp.capture import Capture
from smplxpp.core.atomic import atomic_write_bytes, atomic_write_text
from smplxpp.core.json_values import jsonable

ABLATION = "ablation"
PICTURES = "pictures"
RESULTS_FILE = "results.json"


@dataclass(frozen=True, eq=False)
class AblationRun:
    """How it runs; nothing in it changes a figure.

    Attributes:
        command: in words, for `results.json`.
        device: "cpu" or "cuda". max_seconds: of this call. force: train the rows' pieces anew.
        training: called with the name of a piece and its progress. measuring: with a row, frames done, all frames.
    """

    command: str = ""
    device: str = "cpu"
    max_seconds: float = math.inf
    force: bool = False
    training: Callable[[str, Progress], None] = lambda name, progress: None
    measuring: Callable[[str, int, int], None] = lambda name, done, total: None


@dataclass(frozen=True)
class AblationOutcome:
    """What there is after a call.

    Attributes:
        folder: `RUN/ablation`. table: of the finished rows. results: as in `results.json`.
        waiting: pieces that are still to be trained; none when all is finished.
    """

    folder: Path
    table: FigureTable
    results: dict[str, Any]
    waiting: list[str] = field(default_factory=list)


def ablate(
    run: Path,
    inputs: TrainInputs,
    rows: Mapping[str, Row],
    preset: TrainingPreset,
    config: EvaluationConfig,
    how: AblationRun | None = None,
) -> AblationOutcome:
    """Train and measure rows on a capture with a run's template; what stands is not done again.

    Raises:
        InputError: no template, or a capture that cannot be trained or measured on.
    """
    how = how or AblationRun()
    scene = open_scene(run, inputs)
    config = _measured(config, scene.capture)
    folder = run / ABLATION
    weights = (preset.teacher.weights, preset.bake.weights, preset.compensate.weights)
    perceptual = load_metric(config.metric, device=how.device) if any(w.perceptual for w in weights) else None
    shop = Workshop(scene.capture, scene.template, how.device)
    with own_run_folder(folder, (RESULTS_FILE,)):
        ablation = Ablation(
            shop,
            ablation_pieces(
                preset,
                frame=scene.frame,
                training_frames=len(shop.sequence(CLOTHED).train_frames),
                built_frame=scene.built_frame,
            ),
            folder,
            inputs=scene.digests,
            perceptual=perceptual,
        )
        if how.force:
            ablation.forget(rows)
        else:
            adopt_trained(run, ablation, scene, scale=inputs.scale, perceptual=perceptual)
        observer = Observer(how.training, how.measuring, lambda name, found: _keep_pictures(folder, name, found))
        result = ablation.run(rows, config, max_seconds=how.max_seconds, observer=observer)
        waiting = unfinished(ablation, rows, result.waiting)
        about = {"command": how.command, "preset": preset, "scale": inputs.scale, "device": how.device}
        return _write(folder, result, about, waiting)


def _measured(config: EvaluationConfig, capture: Capture) -> EvaluationConfig:
    """Novel views and novel poses where the capture holds any out; all that there is where it does not."""
    splits = capture.splits
    if config.protocol.sets or not splits.novel_view_cameras:
        return config
    sets = ("novel_view", "novel_pose") if splits.novel_pose_frames else ("novel_view",)
    return replace(config, protocol=replace(config.protocol, sets=sets))


def _keep_pictures(folder: Path, name: str, evaluation: Evaluation) -> None:
    """Photograph and rendering of every shown view side by side, for the rows' strips."""
    for view in evaluation.views:
        (rendered,) = view.rendered.values()
        path = folder / ROWS_FOLDER / name / PICTURES / f"{view.set}_{view_key(view.camera, view.frame)}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(path, encode_png(np.concatenate([view.truth, rendered], axis=1)))


def _write(folder: Path, result: AblationResult, about: Mapping[str, Any], waiting: list[str]) -> AblationOutcome:
    """Table, figures and strips of the finished rows."""
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
    for stale in (*folder.glob("table.*"), *(folder / PICTURES).glob("*.png")):
        stale.unlink()
    if result.rows:
        for suffix, text in (("txt", table.text()), ("csv", table.csv()), ("tex", table.latex(label="tab:ablation"))):
            atomic_write_text(folder / f"table.{suffix}", text)
        _write_strips(folder, result)
    atomic_write_text(folder / RESULTS_FILE, json.dumps(results, indent=1))
    return AblationOutcome(folder, table, results, waiting)


def _write_strips(folder: Path, result: AblationResult) -> None:
    """A strip a view: the photograph, then what each row shows, under their titles."""
    first = next(iter(result.rows))
    for path in sorted((folder / ROWS_FOLDER / first / PICTURES).glob("*.png")):
        pictures = []
        for name, one in result.rows.items():
            pair = folder / ROWS_FOLDER / name / PICTURES / path.name
            if not pair.is_file():
                continue
            photograph, rendered = np.split(_read(pair), 2, axis=1)
            if not pictures:
                pictures.append(caption(photograph, "photograph"))
            pictures.append(caption(rendered, one.row.title))
        (folder / PICTURES).mkdir(exist_ok=True)
        atomic_write_bytes(folder / PICTURES / path.name, encode_png(row(pictures, gap=4)))


def _read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
