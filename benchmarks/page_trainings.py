"""Ablations, trainings and builds as Markdown, for docs/benchmarks.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.page_tables import table, tables_of


def ablation_lines(figures: Mapping[str, Any]) -> list[str]:
    """Return the table of all rows, with head and skin, and the counts where they are stored."""
    columns = {
        "novel_view.psnr": "novel views, PSNR",
        "novel_view.psnr.spread": "SD",
        "novel_view.ssim": "SSIM",
        "novel_view.perceptual": "perceptual",
        "novel_view.psnr_head": "head, PSNR",
        "novel_view.psnr_head_alone": "head alone",
        "novel_view.images": "images",
        "novel_pose.psnr": "novel poses, PSNR",
        "novel_pose.psnr.spread": "SD",
        "novel_pose.ssim": "SSIM",
        "novel_pose.perceptual": "perceptual",
        "novel_pose.psnr_head": "head, PSNR",
        "novel_pose.psnr_head_alone": "head alone",
        "novel_pose.images": "images",
        "refined.novel_pose.psnr": "novel poses refined on training cameras, PSNR",
        "refined.novel_pose.perceptual": "perceptual",
        "refined.novel_pose.psnr_head": "head, PSNR",
        "refined.novel_pose.psnr_head_alone": "head alone",
        "surface.training.p2s": "P2S",
        "surface.training.head.p2s": "P2S head",
        "surface.training.skin.p2s": "P2S skin",
        "surface.training.upper.p2s": "P2S upper",
        "surface.training.lower.p2s": "P2S lower",
        "surface.held_out.p2s": "held out, P2S",
        "surface.held_out.skin.p2s": "P2S skin",
        "surface.held_out.lower.p2s": "P2S lower",
        "megabytes": "MB",
        "minutes": "min",
    }
    rows = figures["rows"]
    there = {key: title for key, title in columns.items() if any(row.get(key) is not None for row in rows.values())}
    about = {name: value for name, value in figures.items() if name != "rows"}
    return [
        "PSNR of the person in dB; head: of its box; alone: of what shows it. P2S in mm, of training frames first.",
        "",
        *table(("row", "what", *there.values()), [(n, r["what"], *(r.get(k) for k in there)) for n, r in rows.items()]),
        "Full against skinning trained on photographs (`LBS Gaussians`): "
        + "; ".join(
            _against(rows["Full"], rows["LBS Gaussians"], key, columns[key]) for key in _COMPARED if key in there
        )
        + ".",
        "",
        *tables_of(about),
    ]


_COMPARED = (
    "novel_view.psnr",
    "novel_pose.psnr",
    "novel_view.psnr_head",
    "novel_pose.psnr_head",
    "refined.novel_pose.psnr",
    "refined.novel_pose.psnr_head",
    "surface.training.skin.p2s",
    "surface.training.lower.p2s",
)


def _against(one: Mapping[str, float], other: Mapping[str, float], key: str, title: str) -> str:
    """Return two rows' figure in words, and which is better."""
    better = one[key] > other[key] if "psnr" in key else one[key] < other[key]
    digits = 1 if "psnr" in key else 2
    of = "refined poses, " if "refined" in key else "novel poses, " if "pose" in key else "novel views, "
    where = of if "head" in key else ""
    verdict = "better" if better else "**worse**"
    return f"{where}{title} {one[key]:.{digits}f} against {other[key]:.{digits}f} ({verdict})"


def training_lines(figures: Mapping[str, Any]) -> list[str]:
    """Return stages, every model on every set of views, surfaces, speed, and where a step's time goes."""
    evaluation = figures["evaluation"]
    views = {
        f"{model}, {part.replace('_', ' ')}": found
        for model, one in evaluation.items()
        for part, found in one.get("views", {}).items()
    }
    surfaces = {
        f"{model}, {part.replace('_', ' ')} frames": found
        for model, one in evaluation.items()
        for part, found in one["surfaces"].items()
    }
    speed = {model: {**one["speed"], "bytes": one["bytes"]} for model, one in evaluation.items() if one.get("speed")}
    stages = {
        name: {key: value for key, value in stage.items() if not isinstance(value, dict)}
        for name, stage in figures["stages"].items()
    }
    images = {
        f"{name}, {when}{kind.replace('_', ' ')}": one[kind]
        for name, stage in figures["stages"].items()
        for when, one in (("at its start, ", stage.get("start", {})), ("", stage))
        for kind in ("novel_view", "novel_pose")
        if kind in one
    }
    conditions = {name: figures[name] for name in ("inputs", "perceptual") if name in figures}
    return [
        f"Preset `{figures['preset']}`, {figures['threads']} threads, {figures['minutes']} minutes.",
        "",
        *tables_of(conditions),
        "Images, all models by the same rules (PSNR and SSIM as docs/evaluation.md defines them):",
        "",
        *tables_of(views),
        "Surfaces, mm:",
        "",
        *tables_of(surfaces),
        "Speed and size:",
        "",
        *tables_of(speed),
        "Stages of the training:",
        "",
        *tables_of(stages),
        "Images as the trainings measured them, on views of their own choice:",
        "",
        *tables_of(images),
        *(["Shares of a step:", "", *tables_of(shares)] if (shares := figures.get("share_of_a_step")) else []),
    ]


def build_lines(figures: Mapping[str, Any]) -> list[str]:
    """Return seconds and memory, stages, and every check of each build."""
    summary = {
        name: {
            "seconds": one["wall_seconds"],
            "all runs": one["wall_seconds_all"],
            "peak GiB": one["peak_gib"],
            **one["status"],
        }
        for name, one in figures.items()
    }
    stages = {name: one["stage_seconds"] for name, one in figures.items()}
    checks = {name: one["checks"] for name, one in figures.items()}
    parts = (("", summary), ("Seconds of the stages:", stages), ("Checks:", checks))
    return [line for title, rows in parts for line in ([title, ""] if title else []) + tables_of(rows)]
