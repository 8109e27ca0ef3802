"""Make the tables of an evaluation: images by set of views, surface, cost, and a summary with a row a model."""

from __future__ import annotations

from collections.abc import Mapping

from avatar.evaluation.input_protocol import counted
from avatar.evaluation.protocol import SETS
from avatar.evaluation.report import PASSES, SKINNING_ALONE, SURFACE_SETS, EvalReport, ModelFigures, Surfaces
from avatar.evaluation.tables import Column, FigureTable
from avatar.metrics.surface_quality import HEAD
from smplxpp.core.labels import CLOTH_LABELS, LABELS, SKIN

MEGABYTE = 1e6


SPREAD = ".spread"
"""End of the key of a standard deviation over frames."""
SPREAD_TITLE = "SD"
SPREAD_CONVENTION = (
    "SD: standard deviation over frames, by n - 1, each frame counted with the mean over its cameras; "
    "none for fewer than two frames."
)


def summary_figures(model: ModelFigures) -> dict[str, float | None]:
    """Return every mean figure of a model under one key each.

    `SET.FIGURE` of the views (`novel_view.psnr`), `surface.training.p2s`, `surface.held_out.lower.p2s`, `fps`,
    `pose_ms`, `deform_ms`, `render_ms`, `gaussians`, `parameters`, `megabytes`; behind the first two kinds also
    `.spread`, a standard deviation over frames; `SET.images`, `SET.frames` and `surface.SET.frames` are counts.
    """
    out: dict[str, float | None] = {}
    # The mean of each figure over the views of a set, its standard deviation over frames, and the counts behind both.
    for name in model.views:
        counts = model.counts(name)
        out |= {f"{name}.{key}": value for key, value in model.mean(name).items()}
        out |= {f"{name}.{key}{SPREAD}": value for key, value in model.spread(name).items()}
        out |= {f"{name}.images": counts.images, f"{name}.frames": counts.frames}
    out |= surface_figures(model.surfaces)
    if model.speed is not None:
        out |= {key: getattr(model.speed, key) for key in ("fps", "pose_ms", "deform_ms", "render_ms", "gaussians")}
    out["parameters"] = model.parameters.get("total")
    out["megabytes"] = None if model.bytes is None else model.bytes / MEGABYTE
    return out


def surface_figures(surfaces: Mapping[str, Surfaces]) -> dict[str, float | None]:
    """Return mean distances by `surface.SET.FIGURE`, of a label by `surface.SET.LABEL.FIGURE`, with their spreads."""
    out: dict[str, float | None] = {}
    for name, one in surfaces.items():
        # The whole surface first, then each label's part of it.
        for quality, end in ((one.mean, ""), (one.spread, SPREAD)):
            for prefix, part in (("", quality), *((f"{label}.", q) for label, q in quality.labels.items())):
                for key in ("p2s", "truth_to_mesh", "chamfer", "p95"):
                    out[f"surface.{name}.{prefix}{key}{end}"] = getattr(part, key)
        out[f"surface.{name}.frames"] = len(one.frames)
    return out


def garments(report: EvalReport) -> tuple[str, ...]:
    """Return the clothes that surfaces may have figures of: the built-in ones, and a user's own labels."""
    surfaces = [report.skinning_alone, *(model.surfaces for model in report.models.values())]
    every = [one for by_set in surfaces for one in by_set.values()]
    found = dict.fromkeys(name for one in every for name in one.mean.labels)
    own = (name for name in found if name not in (HEAD, *LABELS.names))
    return (*(label.name for label in CLOTH_LABELS), *own)


def summary_table(report: EvalReport) -> FigureTable:
    """Make the summary table, a row a model: novel views, novel poses, surface, cost."""
    metric, lpips = report.metric or "", report.lpips or ""
    # Groups of columns: two sets of views, two parts of surfaces, and the cost. Those without figures vanish.
    columns = []
    for name in ("novel_view", "novel_pose"):
        columns += [
            Column(f"{name}.psnr", "PSNR", SETS[name], 2, "higher"),
            Column(f"{name}.psnr{SPREAD}", SPREAD_TITLE, SETS[name], 2),
            Column(f"{name}.ssim", "SSIM", SETS[name], 4, "higher"),
            Column(f"{name}.detail", "detail", SETS[name], 2),
            Column(f"{name}.perceptual", metric, SETS[name], 4, "lower"),
            Column(f"{name}.lpips", lpips, SETS[name], 4, "lower"),
            Column(f"{name}.psnr_head", "head", SETS[name], 2, "higher"),
            Column(f"{name}.images", "images", SETS[name], 0),
        ]
    for name, title in SURFACE_SETS.items():
        columns.append(Column(f"surface.{name}.p2s", "P2S", f"{title}, mm", 2, "lower"))
        columns.append(Column(f"surface.{name}.chamfer", "Chamfer", f"{title}, mm", 2, "lower"))
        columns.append(Column(f"surface.{name}.{SKIN.name}.p2s", "P2S skin", f"{title}, mm", 2, "lower"))
    columns += [Column("fps", "FPS", "", 1, "higher"), Column("megabytes", "MB", "", 2, "lower")]
    rows = {name: summary_figures(model) for name, model in report.models.items()}
    return FigureTable(
        tuple(columns), rows, report.inputs.caption(f"evaluation on {report.capture}; {report.inputs.sentence()}")
    )


def image_table(report: EvalReport, name: str, *, of: str | None = None) -> FigureTable:
    """Make the table of the image figures of one set of views; `of` one of `PASSES`, or None for the models' own."""
    models = getattr(report, of or "models")
    title = f"{SETS[name]}{PASSES[of] if of else ''}"
    metric, lpips = report.metric or "", report.lpips or ""
    # The person's PSNR comes first, since the plain background inflates the figures of whole images.
    columns = (
        Column("images", "images", "", 0),
        Column("frames", "frames", "", 0),
        Column("psnr", "PSNR", "person", 2, "higher"),
        Column(f"psnr{SPREAD}", SPREAD_TITLE, "person", 2),
        Column("psnr_image", "PSNR", "whole image", 2, "higher"),
        Column("ssim", "SSIM", "whole image", 4, "higher"),
        Column(f"ssim{SPREAD}", SPREAD_TITLE, "whole image", 4),
        Column("detail", "detail", "person", 2),
        Column("perceptual", metric, "whole image", 4, "lower"),
        Column(f"perceptual{SPREAD}", SPREAD_TITLE, "whole image", 4),
        Column("lpips", lpips, "whole image", 4, "lower"),
        Column(f"lpips{SPREAD}", SPREAD_TITLE, "whole image", 4),
        Column("psnr_head", "PSNR", "head", 2, "higher"),
        Column(f"psnr_head{SPREAD}", SPREAD_TITLE, "head", 2),
        Column("psnr_head_alone", "alone", "head", 2, "higher"),
        Column("ssim_head", "SSIM", "head", 4, "higher"),
        Column("perceptual_head", metric, "head", 4, "lower"),
        Column("lpips_head", lpips, "head", 4, "lower"),
    )
    # All models are measured on the same views, so that the counts of any of them hold for the caption.
    rows = {model: _of_set(figures, name) for model, figures in models.items() if name in figures.views}
    counts = next(figures.counts(name) for figures in models.values() if name in figures.views)
    held = (
        f"{counted(counts.images, 'image')}, {counted(counts.frames, 'frame')} of {counted(counts.cameras, 'camera')}"
    )
    return FigureTable(columns, rows, report.inputs.caption(f"{title}, {held}; {report.inputs.sentence()}"))


def _of_set(model: ModelFigures, name: str) -> dict[str, float | None]:
    """Return the figures of one set without its name in the keys."""
    start = f"{name}."
    return {key.removeprefix(start): value for key, value in summary_figures(model).items() if key.startswith(start)}


def surface_table(report: EvalReport) -> FigureTable:
    """Make the table of distances to the true surface, of all, head, skin and each cloth, skinning alone first."""
    # Each part has one group of columns: distances of the whole surface, then of head, skin and each cloth.
    columns = []
    for name, title in SURFACE_SETS.items():
        group = f"{title}, mm"
        columns += [
            Column(f"surface.{name}.frames", "frames", group, 0),
            Column(f"surface.{name}.p2s", "P2S", group, 2, "lower"),
            Column(f"surface.{name}.p2s{SPREAD}", SPREAD_TITLE, group, 2),
            Column(f"surface.{name}.truth_to_mesh", "truth to mesh", group, 2, "lower"),
            Column(f"surface.{name}.chamfer", "Chamfer", group, 2, "lower"),
        ]
        columns += [
            Column(f"surface.{name}.{part}.p2s", f"P2S {part}", group, 2, "lower")
            for part in (HEAD, SKIN.name, *garments(report))
        ]
    # Skinning alone is the reference that every deformation has to improve upon.
    rows = {SKINNING_ALONE: surface_figures(report.skinning_alone)} if report.skinning_alone else {}
    # The same poses with the clothes of `followed_clothes`: their rows stand beside the models' own.
    followed = {f"{name}{PASSES['followed_clothes']}": model for name, model in report.followed_clothes.items()}
    models = {**report.models, **followed}
    rows |= {name: surface_figures(model.surfaces) for name, model in models.items() if model.surfaces}
    return FigureTable(
        tuple(columns), rows, report.inputs.caption(f"posed mesh and true surface; {report.inputs.sentence()}")
    )


def cost_table(report: EvalReport) -> FigureTable:
    """Make the table of speed and size."""
    # Models are timed under the same conditions, so that the first one's device and size hold for all.
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
    return FigureTable(columns, rows, report.inputs.caption(f"speed{where} and size"))


def pose_table(report: EvalReport) -> FigureTable:
    """Make the table of errors of the poses in use against the exact ones."""
    columns = (
        Column("frames", "frames", "", 0),
        Column("body_mm", "body", "mm", 1, "lower"),
        Column("bare_mm", "under bare skin", "mm", 1, "lower"),
        Column("covered_mm", "under cloth", "mm", 1, "lower"),
        Column("joints_mm", "joints", "mm", 1, "lower"),
        Column("degrees", "degrees a joint", "", 2, "lower"),
    )
    caption = report.inputs.caption("poses in use against the exact ones, which nothing else here has seen")
    return FigureTable(columns, {name: vars(one) for name, one in report.poses.items()}, caption, row_title="poses")


def evaluation_tables(report: EvalReport) -> dict[str, FigureTable]:
    """Make every table by the name of its file; those without a row are left out."""
    # One table a set of views; refined poses have tables of their own, because they use photographs of held-out frames.
    tables = {"summary": summary_table(report)}
    measured = [name for name in SETS if any(name in model.views for model in report.models.values())]
    tables |= {name: image_table(report, name) for name in measured}
    for key in PASSES:
        again = [name for name in SETS if any(name in model.views for model in getattr(report, key).values())]
        tables |= {f"{name}_{key.split('_')[0]}": image_table(report, name, of=key) for name in again}
    tables |= {"poses": pose_table(report)}
    tables |= {"surface": surface_table(report), "cost": cost_table(report)}
    return {name: table for name, table in tables.items() if table.rows and table.columns}
