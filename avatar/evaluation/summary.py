"""The tables of an evaluation: images by set of views, surface, cost, and all in one line a model."""

from __future__ import annotations

from avatar.evaluation.protocol import SETS
from avatar.evaluation.report import SKINNING_ALONE, SURFACE_SETS, EvalReport, ModelFigures, Surfaces
from avatar.evaluation.tables import Column, FigureTable
from smplxpp.core.labels import CLOTH_LABELS

MEGABYTE = 1e6


def summary_figures(model: ModelFigures) -> dict[str, float | None]:
    """Every mean figure of a model under one key each.

    `SET.FIGURE` of the views (`novel_view.psnr`), `surface.training.p2s`, `surface.held_out.lower.p2s`, `fps`,
    `pose_ms`, `deform_ms`, `render_ms`, `gaussians`, `parameters`, `megabytes`.
    """
    out: dict[str, float | None] = {
        f"{name}.{key}": value for name in model.views for key, value in model.mean(name).items()
    }
    out |= surface_figures(model.surfaces)
    if model.speed is not None:
        out |= {key: getattr(model.speed, key) for key in ("fps", "pose_ms", "deform_ms", "render_ms", "gaussians")}
    out["parameters"] = model.parameters.get("total")
    out["megabytes"] = None if model.bytes is None else model.bytes / MEGABYTE
    return out


def surface_figures(surfaces: dict[str, Surfaces]) -> dict[str, float | None]:
    """Mean distances by `surface.SET.FIGURE`, of a label by `surface.SET.LABEL.FIGURE`."""
    out: dict[str, float | None] = {}
    for name, one in surfaces.items():
        for prefix, quality in (("", one.mean), *((f"{label}.", q) for label, q in one.mean.labels.items())):
            for key in ("p2s", "truth_to_mesh", "chamfer", "p95"):
                out[f"surface.{name}.{prefix}{key}"] = getattr(quality, key)
    return out


def summary_table(report: EvalReport) -> FigureTable:
    """The line that a paper prints of every model: novel views, novel poses, surface, cost."""
    metric = report.metric or ""
    columns = []
    for name in ("novel_view", "novel_pose"):
        columns += [
            Column(f"{name}.psnr", "PSNR", SETS[name], 2, "higher"),
            Column(f"{name}.ssim", "SSIM", SETS[name], 4, "higher"),
            Column(f"{name}.perceptual", metric, SETS[name], 4, "lower"),
        ]
    for name, title in SURFACE_SETS.items():
        columns.append(Column(f"surface.{name}.p2s", "P2S", f"{title}, mm", 2, "lower"))
        columns.append(Column(f"surface.{name}.chamfer", "Chamfer", f"{title}, mm", 2, "lower"))
    columns += [Column("fps", "FPS", "", 1, "higher"), Column("megabytes", "MB", "", 2, "lower")]
    rows = {name: summary_figures(model) for name, model in report.models.items()}
    return FigureTable(tuple(columns), rows, f"Evaluation on {report.capture}")


def image_table(report: EvalReport, name: str) -> FigureTable:
    """Image figures of one set of views."""
    metric = report.metric or ""
    columns = (
        Column("views", "views", "", 0),
        Column("psnr", "PSNR", "person", 2, "higher"),
        Column("psnr_image", "PSNR", "whole image", 2, "higher"),
        Column("ssim", "SSIM", "whole image", 4, "higher"),
        Column("perceptual", metric, "whole image", 4, "lower"),
        Column("psnr_head", "PSNR", "head", 2, "higher"),
        Column("ssim_head", "SSIM", "head", 4, "higher"),
        Column("perceptual_head", metric, "head", 4, "lower"),
    )
    rows = {
        model: {"views": len(figures.views[name]), **figures.mean(name)}
        for model, figures in report.models.items()
        if name in figures.views
    }
    return FigureTable(columns, rows, SETS[name])


def surface_table(report: EvalReport) -> FigureTable:
    """Distances to the true surface, of all and of each cloth, skinning alone in the first row."""
    columns = []
    for name, title in SURFACE_SETS.items():
        group = f"{title}, mm"
        columns += [
            Column(f"surface.{name}.p2s", "P2S", group, 2, "lower"),
            Column(f"surface.{name}.truth_to_mesh", "truth to mesh", group, 2, "lower"),
            Column(f"surface.{name}.chamfer", "Chamfer", group, 2, "lower"),
        ]
        columns += [
            Column(f"surface.{name}.{label.name}.p2s", f"P2S {label.name}", group, 2, "lower") for label in CLOTH_LABELS
        ]
    rows = {SKINNING_ALONE: surface_figures(report.skinning_alone)} if report.skinning_alone else {}
    rows |= {name: surface_figures(model.surfaces) for name, model in report.models.items() if model.surfaces}
    return FigureTable(tuple(columns), rows, "Posed mesh and true surface")


def cost_table(report: EvalReport) -> FigureTable:
    """Speed and size."""
    speed = next((m.speed for m in report.models.values() if m.speed is not None), None)
    where = "" if speed is None else f" at {speed.width} x {speed.height}, {speed.device}"
    if speed is not None and speed.threads:
        where += f", {speed.threads} thread{'s' if speed.threads > 1 else ''}"
    columns = (
        Column("fps", "FPS", "", 1, "higher"),
        Column("pose_ms", "pose", "ms", 1, "lower"),
        Column("deform_ms", "deform", "ms", 1, "lower"),
        Column("render_ms", "render", "ms", 1, "lower"),
        Column("gaussians", "Gaussians", "", 0),
        Column("parameters", "parameters", "", 0, "lower"),
        Column("megabytes", "MB", "", 2, "lower"),
    )
    rows = {name: summary_figures(model) for name, model in report.models.items()}
    return FigureTable(columns, rows, f"Speed{where} and size")


def evaluation_tables(report: EvalReport) -> dict[str, FigureTable]:
    """Every table by the name of its file; those without a row are left out."""
    tables = {"summary": summary_table(report)}
    measured = [name for name in SETS if any(name in model.views for model in report.models.values())]
    tables |= {name: image_table(report, name) for name in measured}
    tables |= {"surface": surface_table(report), "cost": cost_table(report)}
    return {name: table for name, table in tables.items() if table.rows and table.columns}
