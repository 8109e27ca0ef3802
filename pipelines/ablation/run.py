"""The ablation: variants of the system trained on one capture, measured by one protocol, in one table.

    rows = ablation_rows(("paper",))
    pieces = ablation_pieces(preset, frame=0, training_frames=len(capture.splits.train_frames))
    ablation = Ablation(Workshop(capture, template), pieces, Path("work"), inputs={})
    table = ablation_table(ablation.run(rows, EvaluationConfig())).text()

Every piece and every row is made once and kept; the same call goes on where it was interrupted.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from avatar.evaluation.evaluate import Evaluation, EvaluationConfig, evaluate_models
from avatar.evaluation.protocol import SETS
from avatar.evaluation.report import SURFACE_SETS, EvalReport
from avatar.evaluation.summary import summary_figures
from avatar.evaluation.tables import Column, FigureTable
from avatar.losses.perceptual import PerceptualDistance
from avatar.rig.posed import PosedAvatar
from avatar.rig.rig import Motion
from avatar.training.engine.loop import METRICS_FILE, STATE_FILE, Progress
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.train import Session
from pipelines.ablation.pieces import CLOTHED, Piece, Workshop
from pipelines.ablation.rows import Row
from pipelines.runs.stage import stage_key
from smplxpp.core.atomic import atomic_write_text
from smplxpp.core.json_values import jsonable
from smplxpp.core.labels import CLOTH_LABELS

PIECE_FILE, RECORD_FILE = "avatar.safetensors", "piece.json"
PLAYER_FILE, REPORT_FILE, ROW_FILE = "player.safetensors", "report.json", "row.json"
ROWS_FOLDER = "rows"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RowResult:
    """A row that was trained and measured.

    Attributes:
        row: what it is. report: of its one model, named by the row's title.
        seconds: of training steps, over all pieces that it took. iterations: likewise.
    """

    row: Row
    report: EvalReport
    seconds: float
    iterations: int


@dataclass(frozen=True)
class AblationResult:
    """Rows in their order.

    Attributes:
        rows: by name, those that are finished. waiting: names of those that are not: time ran out.
    """

    rows: dict[str, RowResult]
    waiting: tuple[str, ...]

    @property
    def report(self) -> EvalReport:
        """All rows' models in one."""
        reports = [one.report for one in self.rows.values()]
        models = {title: model for report in reports for title, model in report.models.items()}
        alone = next((report.skinning_alone for report in reports if report.skinning_alone), {})
        conventions = {name: text for report in reports for name, text in report.conventions.items()}
        return EvalReport(reports[0].capture, reports[0].metric, models, alone, conventions)


@dataclass(frozen=True, eq=False)
class Observer:
    """Who is told what an ablation does.

    Attributes:
        training: called with the name of a piece and its progress. measuring: with a row, frames done and all frames.
        measured: with a row and its evaluation, pictures included, once.
    """

    training: Callable[[str, Progress], None] = lambda name, progress: None
    measuring: Callable[[str, int, int], None] = lambda name, done, total: None
    measured: Callable[[str, Evaluation], None] = lambda name, evaluation: None


class Ablation:
    """Pieces and rows of an ablation in a folder: `FOLDER/PIECE/` and `FOLDER/rows/ROW/`.

    Args:
        shop: capture and person. pieces: by name, a piece after those that it needs.
        folder: of everything.
        inputs: digests of what the shop was read from; with the pieces' configurations they decide what still stands.
        perceptual: for the losses' perceptual term, None leaves it out.
    """

    def __init__(
        self,
        shop: Workshop,
        pieces: Mapping[str, Piece],
        folder: Path,
        *,
        inputs: Mapping[str, str],
        perceptual: PerceptualDistance | None = None,
    ) -> None:
        self.shop, self.pieces, self.folder, self.inputs = shop, pieces, Path(folder), inputs
        self.perceptual = perceptual
        self._keys: dict[str, str] = {}

    def run(
        self,
        rows: Mapping[str, Row],
        config: EvaluationConfig,
        *,
        max_seconds: float = float("inf"),
        observer: Observer | None = None,
    ) -> AblationResult:
        """Train and measure rows, as far as time allows; what stands is not done again.

        The full system comes first, whatever its place: most rows share its pieces.

        Args:
            max_seconds: of this call; training then stops with a checkpoint and nothing new is begun.
        """
        observer = observer or Observer()
        end = time.monotonic() + max_seconds
        results: dict[str, RowResult] = {}
        for name in sorted(rows, key=lambda name: name != "full"):
            finished = all(self._make(piece, end, observer) for piece in self.closure(rows[name].piece))
            if finished and (self._row_stands(name, rows[name], config) or time.monotonic() < end):
                results[name] = self._measure(name, rows[name], config, observer)
        ordered = {name: results[name] for name in rows if name in results}
        return AblationResult(ordered, tuple(name for name in rows if name not in results))

    def closure(self, name: str) -> list[str]:
        """A piece after all that it is made from, each once."""
        names: list[str] = []
        for needed in (*self.pieces[name].needs, None):
            for piece in [name] if needed is None else self.closure(needed):
                if piece not in names:
                    names.append(piece)
        return names

    def key(self, name: str) -> str:
        """What decides a piece: its configuration, those of all that it is made from, the inputs."""
        if name not in self._keys:
            chain = [
                {"kind": type(piece).__name__, **jsonable(piece)} for piece in map(self.pieces.get, self.closure(name))
            ]
            metric = None if self.perceptual is None else self.perceptual.name
            config = {"pieces": chain, "device": self.shop.device, "perceptual": metric}
            self._keys[name] = stage_key(config=config, inputs=self.inputs)
        return self._keys[name]

    def record(self, name: str) -> dict[str, Any] | None:
        """Key, seconds and iterations of a piece that stands, else None."""
        record = _read_json(self.folder / name / RECORD_FILE)
        stands = record.get("key") == self.key(name) and (self.folder / name / PIECE_FILE).is_file()
        return record if stands else None

    def piece(self, name: str) -> Any:
        """A finished piece, read from its file."""
        return self.pieces[name].read(self.folder / name / PIECE_FILE, self.shop, self.piece)

    def adopt(self, name: str, path: Path, *, seconds: float, iterations: int) -> None:
        """Take a file that was made as the piece is, by other means, in its place."""
        self.pieces[name].write(self.pieces[name].read(path, self.shop, self.piece), self.folder / name / PIECE_FILE)
        self._finish(name, seconds, iterations)

    def forget(self, rows: Mapping[str, Row]) -> None:
        """Remove rows and all pieces that they are made from, checkpoints included."""
        for name, row in rows.items():
            shutil.rmtree(self.folder / ROWS_FOLDER / name, ignore_errors=True)
            for piece in self.closure(row.piece):
                shutil.rmtree(self.folder / piece, ignore_errors=True)

    def _make(self, name: str, end: float, observer: Observer) -> bool:
        """Train a piece unless it stands; whether it does then."""
        if self.record(name) is not None:
            return True
        if time.monotonic() >= end:
            return False
        log.info("ablation: training %s", name)
        piece, folder = self.pieces[name], self.folder / name
        if (folder / RECORD_FILE).is_file():
            # Of a finished piece that no longer stands; a training that is resumed keeps its own.
            for stale in (*folder.rglob(METRICS_FILE), folder / RECORD_FILE):
                stale.unlink()
        session = Session(
            folder,
            key=self.key(name),
            perceptual=self.perceptual,
            max_seconds=end - time.monotonic(),
            report=lambda progress: observer.training(name, progress),
        )
        begin = time.perf_counter()
        product, progress = piece.make(self.shop, self.piece, session)
        if progress is not None and not progress.finished:
            return False
        piece.write(product, folder / PIECE_FILE)
        seconds, iterations = (time.perf_counter() - begin, 0) if progress is None else _spent(folder)
        self._finish(name, seconds, iterations)
        return True

    def _finish(self, name: str, seconds: float, iterations: int) -> None:
        """Record a piece whose file is written."""
        done = {"key": self.key(name), "seconds": seconds, "iterations": iterations}
        atomic_write_text(self.folder / name / RECORD_FILE, json.dumps(done, indent=1))
        for state in (self.folder / name).rglob(STATE_FILE):
            state.unlink()

    def _row_key(self, row: Row, config: EvaluationConfig) -> str:
        return stage_key(config={"row": row, "evaluation": config}, inputs={"piece": self.key(row.piece)})

    def _row_stands(self, name: str, row: Row, config: EvaluationConfig) -> bool:
        found = _read_json(self.folder / ROWS_FOLDER / name / ROW_FILE)
        return found.get("key") == self._row_key(row, config)

    def _measure(self, name: str, row: Row, config: EvaluationConfig, observer: Observer) -> RowResult:
        """Figures of a row, from its report if that stands; the model is measured as its player's file holds it."""
        folder = self.folder / ROWS_FOLDER / name
        if not self._row_stands(name, row, config):
            log.info("ablation: measuring %s", row.title)
            folder.mkdir(parents=True, exist_ok=True)
            piece, player = self.pieces[row.piece], folder / PLAYER_FILE
            piece.write(self.piece(row.piece), player, compact=True)
            model = piece.read(player, self.shop, self.piece)
            evaluation = evaluate_models(
                {row.title: WithoutCode(model) if row.null_code else model},
                self.shop.sequence(CLOTHED),
                config,
                files={row.title: player},
                progress=lambda done, total: observer.measuring(name, done, total),
            )
            observer.measured(name, evaluation)
            evaluation.report.save(folder / REPORT_FILE)
            atomic_write_text(folder / ROW_FILE, json.dumps({"key": self._row_key(row, config)}))
        records = [self.record(piece) for piece in self.closure(row.piece)]
        seconds, iterations = (sum(record[key] for record in records) for key in ("seconds", "iterations"))
        return RowResult(row, EvalReport.load(folder / REPORT_FILE), seconds, iterations)


class WithoutCode(nn.Module):
    """An avatar that is driven by the null code in every frame, as it is online."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model, self.rig = model, model.rig

    def forward(self, motion: Motion, camera_centers: Tensor) -> PosedAvatar:
        return self.model(motion.without_code(), camera_centers)


def ablation_table(result: AblationResult) -> FigureTable:
    """One line a row: novel views, novel poses, distances to the true surface, bytes and time of training."""
    metric, capture = (result.report.metric or "", result.report.capture) if result.rows else ("", "")
    shown = [
        name
        for name in SETS
        if any(name in one.views for r in result.rows.values() for one in r.report.models.values())
    ]
    columns = []
    for name in shown:
        columns += [
            Column(f"{name}.psnr", "PSNR", SETS[name], 2, "higher"),
            Column(f"{name}.ssim", "SSIM", SETS[name], 4, "higher"),
            Column(f"{name}.perceptual", metric, SETS[name], 4, "lower"),
        ]
    for name, title in SURFACE_SETS.items():
        group = f"{title}, mm"
        columns += [
            Column(f"surface.{name}.p2s", "P2S", group, 2, "lower"),
            Column(f"surface.{name}.chamfer", "Chamfer", group, 2, "lower"),
        ]
        columns += [
            Column(f"surface.{name}.{label.name}.p2s", f"P2S {label.name}", group, 2, "lower") for label in CLOTH_LABELS
        ]
    columns += [Column("megabytes", "MB", "", 1, "lower"), Column("minutes", "min", "training", 1)]
    rows = {one.row.title: row_figures(one) for one in result.rows.values()}
    return FigureTable(tuple(columns), rows, f"Ablation on {capture}", row_title="")


def row_figures(result: RowResult) -> dict[str, float | None]:
    """Every mean figure of a row, see `summary_figures`; `minutes` and `iterations` of training."""
    figures = summary_figures(result.report.models[result.row.title])
    return {**figures, "minutes": result.seconds / 60.0, "iterations": float(result.iterations)}


def unfinished(ablation: Ablation, rows: Mapping[str, Row], names: Sequence[str]) -> list[str]:
    """Pieces that rows still need, in the order in which they are made."""
    pieces = [piece for name in names for piece in ablation.closure(rows[name].piece)]
    return [piece for piece in dict.fromkeys(pieces) if ablation.record(piece) is None]


def _spent(folder: Path) -> tuple[float, int]:
    """Seconds and iterations of all trainings that logged in a piece's folder: a teacher's may be two."""
    last = [read_metrics(path)[-1] for path in sorted(folder.rglob(METRICS_FILE))]
    return sum(entry["seconds"] for entry in last), sum(entry["iteration"] for entry in last)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
