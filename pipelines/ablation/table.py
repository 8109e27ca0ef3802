"""The ablation's table: one line a row."""

from __future__ import annotations

from dataclasses import dataclass, replace

from avatar.evaluation.protocol import SETS
from avatar.evaluation.report import SURFACE_SETS, EvalReport
from avatar.evaluation.summary import REFINED_POSES, summary_figures
from avatar.evaluation.tables import Column, FigureTable
from pipelines.ablation.measure import RowResult
from smplxpp.core.labels import CLOTH_LABELS

NOVEL_POSE = "novel_pose"
REFINED = "refined."
"""Begins the names of figures in held-out poses that were refined on training cameras."""


@dataclass(frozen=True)
class AblationResult:
    """Rows in their order.

    Attributes:
        rows: by name, those that are finished.
    """

    rows: dict[str, RowResult]

    @property
    def report(self) -> EvalReport:
        """All rows' models in one."""
        reports = [one.report for one in self.rows.values()]
        models = {title: model for report in reports for title, model in report.models.items()}
        alone = next((report.skinning_alone for report in reports if report.skinning_alone), {})
        conventions = {name: text for report in reports for name, text in report.conventions.items()}
        refined = {title: model for report in reports for title, model in report.refined_poses.items()}
        first = reports[0]
        return EvalReport(first.capture, first.metric, models, alone, conventions, first.inputs, refined)


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
    if any(r.report.refined_poses for r in result.rows.values()):
        group = f"{SETS[NOVEL_POSE]}{REFINED_POSES}"
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
        columns += [
            Column(f"surface.{name}.{label.name}.p2s", f"P2S {label.name}", group, 2, "lower") for label in CLOTH_LABELS
        ]
    columns += [Column("megabytes", "MB", "", 1, "lower"), Column("minutes", "min", "training", 1)]
    rows = {one.row.title: row_figures(one) for one in result.rows.values()}
    return FigureTable(tuple(columns), rows, _caption(result, capture), row_title="")


def _caption(result: AblationResult, capture: str) -> str:
    if not result.rows:
        return ""
    known = result.report.inputs
    return known.caption(f"ablation on {capture}; {known.sentence()}")


def row_figures(result: RowResult) -> dict[str, float | None]:
    """Every mean figure of a row, see `summary_figures`; `minutes` and `iterations` of training.

    Those of views in refined poses begin with `REFINED`.
    """
    figures = summary_figures(result.report.models[result.row.title])
    again = result.report.refined_poses.get(result.row.title)
    if again is not None:
        views = summary_figures(replace(again, surfaces={}))
        figures |= {f"{REFINED}{key}": value for key, value in views.items() if key.split(".")[0] in again.views}
    return {**figures, "minutes": result.seconds / 60.0, "iterations": float(result.iterations)}
