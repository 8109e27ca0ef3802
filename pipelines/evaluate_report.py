"""The report's section on an evaluation: photograph, reference fit, teacher and student beside each other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avatar.evaluation.protocol import SETS
from avatar.evaluation.report import SURFACE_SETS, EvalReport
from avatar.evaluation.summary import evaluation_tables
from avatar.evaluation.tables import FigureTable
from pipelines.build_config import TEMPLATE
from pipelines.evaluate_pictures import SURFACE_LIMIT_MM, read_tiles
from pipelines.evaluate_stage import BAKED, EVALUATE_STAGE, REPORT_FILE, STUDENT, TEACHER
from pipelines.fit_pictures import ERROR_LIMIT, enlarge, error_colors, error_legend
from pipelines.fit_report import HEAD_HEIGHT
from pipelines.pictures import encode_jpeg, encode_png, row
from pipelines.report import CheckRow, Comparison, KeyNumber, Picture, Section, Table
from smplxpp.core.artifact import StageRecord, read_manifest


def standing_evaluation(run: Path, template_digest: str) -> StageRecord | None:
    """The evaluation in a run, None where there is none or one of another template than the run has now."""
    manifest = read_manifest(run / EVALUATE_STAGE)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != template_digest:
        return None
    return StageRecord(run / EVALUATE_STAGE, manifest, ran=False)


def evaluation_key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    """The numbers for the head of the report: of the student, or of the teacher where there is no student."""
    models = record.manifest["numbers"]["models"]
    name = next((name for name in (STUDENT, BAKED, TEACHER) if name in models), None)
    if name is None:
        return ()
    figures, out = models[name], []
    for part in ("novel_view", "novel_pose"):
        if figures.get(f"{part}.psnr") is not None:
            note = f"{name}, SSIM {figures[f'{part}.ssim']:.3f}"
            out.append(KeyNumber(SETS[part], f"{figures[f'{part}.psnr']:.1f} dB", note))
    if figures.get("fps") is not None:
        out.append(KeyNumber("avatar", f"{figures['fps']:.0f} pictures a second", f"{name}, deform and render"))
    return tuple(out)


def evaluation_section(record: StageRecord) -> Section:
    """Pictures of every set of views, distances on the meshes, all tables and what their figures mean."""
    numbers = record.manifest["numbers"]
    report = EvalReport.load(record.folder / REPORT_FILE)
    pictures, comparisons = [], []
    for shown in numbers["shown"]:
        truth, rendered = read_tiles(record.folder / shown["file"], len(shown["models"]))
        pictures += _view_pictures(shown, truth, rendered)
        comparisons.append(
            Comparison(
                f"{_title(shown)}: photograph and {shown['models'][-1]}, every pixel",
                Picture("photograph", encode_png(truth)),
                Picture(shown["models"][-1], encode_png(rendered[-1])),
            )
        )
    pictures.append(Picture(f"error, of 255: 0 to {ERROR_LIMIT} and more", encode_png(error_legend())))
    for shown in numbers["surfaces"]:
        title = f"{SURFACE_SETS[shown['set']]}, frame {shown['frame']}: distance to the true surface"
        caption = f"{title}, {', '.join(shown['meshes'])}, 0 to {SURFACE_LIMIT_MM:g} mm"
        pictures.append(Picture(caption, (record.folder / shown["file"]).read_bytes()))
    return Section(
        title="Avatar",
        text=(
            f"{_listed(list(report.models))} on the same views. Training views: cameras and frames that were trained "
            "on. Novel views: held-out cameras at training frames. Novel poses: the same cameras at held-out frames. "
            f"Error: the largest difference of a colour channel at a pixel, from 0 (pale) to {ERROR_LIMIT} of 255 and "
            f"more (dark). All figures and these tables lie in {EVALUATE_STAGE}.",
            *(f"{name[0].upper()}{name[1:]}. {words}" for name, words in report.conventions.items()),
        ),
        pictures=tuple(pictures),
        comparisons=tuple(comparisons),
        tables=tuple(_table(table) for table in evaluation_tables(report).values()),
        checks=tuple(CheckRow.of(check, stage=EVALUATE_STAGE) for check in record.manifest["checks"]),
    )


def _view_pictures(shown: Mapping[str, Any], truth: np.ndarray, rendered: list[np.ndarray]) -> list[Picture]:
    """The view whole, its head enlarged, each with every model's error below the model."""
    names = ", ".join(["photograph", *shown["models"]])
    out = [Picture(f"{_title(shown)}: {names}; errors below", encode_png(_with_errors(truth, rendered)))]
    if shown["head"] is not None:
        x0, y0, x1, y1 = shown["head"]
        factor = max(1, round(HEAD_HEIGHT / (y1 - y0)))
        crops = [enlarge(image[y0:y1, x0:x1], factor) for image in (truth, *rendered)]
        picture = encode_jpeg(_with_errors(crops[0], crops[1:]), quality=92)
        out.append(Picture(f"{_title(shown)}, head, {factor} times enlarged: {names}; errors below", picture))
    return out


def _with_errors(truth: np.ndarray, rendered: list[np.ndarray]) -> np.ndarray:
    """Photograph and renderings in a row, errors under the renderings."""
    blank = np.full_like(truth, 255)
    errors = row([blank, *(error_colors(truth, image) for image in rendered)])
    images = row([truth, *rendered])
    gap = np.full((12, images.shape[1], 3), 255, np.uint8)
    return np.concatenate([images, gap, errors])


def _title(shown: Mapping[str, Any]) -> str:
    return f"{SETS[shown['set']]}, {shown['camera']}, frame {shown['frame']}"


def _listed(names: list[str]) -> str:
    """Names in a sentence, the first with a capital."""
    text = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return text[0].upper() + text[1:]


def _table(table: FigureTable) -> Table:
    """As text with the digits that the table gives; titles carry their group."""
    titles = [f"{c.group}: {c.title}" if c.group else c.title for c in table.columns]
    return Table((table.row_title, *titles), tuple(map(tuple, table.cells())), table.caption)
