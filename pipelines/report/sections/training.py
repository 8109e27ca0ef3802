"""The report's sections on refined poses and on the trainings, from the files of their stages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avatar.training.engine.metrics_log import read_metrics
from pipelines.report import CheckRow, Comparison, Curve, KeyNumber, Picture, Section, Table
from pipelines.runs.layout import (
    BAKE_STAGE,
    COMPENSATE_STAGE,
    KINDS,
    REFINE_STAGE,
    TEACHER_STAGE,
    TEMPLATE,
    TRAIN_STAGES,
    kind_name,
)
from pipelines.runs.stage import StageRecord, read_manifest
from smplxpp.core.files.paths import path_inside
from smplxpp.core.spread import spread
from smplxpp.figures import encode_png, row
from smplxpp.figures.drawings import ERROR_LIMIT, error_legend, read_strip, read_tiles

SHOWN_VIEWS = 4
CURVE_POINTS = 300
_FIGURES = {"psnr": "PSNR of the person, dB", "psnr_image": "of the image", "ssim": "SSIM"}
_TITLES = {
    TEACHER_STAGE: ("Teacher", "Networks on maps of the posed mesh give every Gaussian its residuals in every pose."),
    BAKE_STAGE: (
        "Bake",
        "A small field moves the student's mesh as the teacher moves its Gaussians; the student renders without maps.",
    ),
    COMPENSATE_STAGE: (
        "Compensation",
        "Blend shapes of the Gaussians learn what the mesh's motion leaves over. This is the avatar that runs.",
    ),
}


def standing_trainings(run: Path, records: Iterable[StageRecord]) -> dict[str, StageRecord]:
    """Return the trainings of a run by stage, without those whose input files have changed since.

    Args:
        records: earlier stages that stand.
    """
    digests = {
        f"{record.folder.name}/{file}": digest
        for record in records
        for file, digest in record.manifest["files"].items()
    }
    found, outdated = {}, set()
    # Stages are in the order of work: one whose input has another digest, or comes from an outdated stage, is
    # outdated too.
    for stage in TRAIN_STAGES:
        manifest = read_manifest(run / stage)
        if manifest is None:
            continue
        inputs = manifest["inputs"].items()
        if any(digests.get(file, digest) != digest or file.split("/")[0] in outdated for file, digest in inputs):
            outdated.add(stage)
            continue
        found[stage] = StageRecord(run / stage, manifest, ran=False)
        digests |= {f"{stage}/{file}": digest for file, digest in manifest["files"].items()}
    return found


def training_key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    """The numbers of a training for the head of the report."""
    numbers = record.manifest["numbers"]
    who = "teacher" if record.folder.name == TEACHER_STAGE else "student"
    return tuple(
        KeyNumber(
            f"{who}, {kind_name(kind, held_out=numbers['held_out_cameras'])}: PSNR of the person",
            f"{numbers[kind]['psnr']:.1f} dB",
            f"SSIM {numbers[kind]['ssim']:.3f}",
        )
        for kind in KINDS
        if kind in numbers
    )


def training_section(record: StageRecord) -> Section:
    """Figures at the start and the end, quality and loss over time, photographs beside renderings."""
    stage, numbers = record.folder.name, record.manifest["numbers"]
    title, what = _TITLES[stage]
    pictures, comparisons = _pictures(record.folder)
    lines = read_metrics(record.folder / "metrics.jsonl")
    return Section(
        title=title,
        text=(what, _how(numbers), _files(numbers)),
        pictures=(*pictures, Picture(f"error, of 255: 0 to {ERROR_LIMIT} and more", encode_png(error_legend()))),
        comparisons=comparisons,
        curves=_curves(lines, held_out=numbers["held_out_cameras"]),
        tables=(_table(numbers),),
        checks=tuple(CheckRow.of(check, stage=stage) for check in record.manifest["checks"]),
    )


def _how(numbers: Mapping[str, Any]) -> str:
    stopped = "" if numbers["finished"] else " The limit of time ended it; the same command continues."
    # Peak memory of host and GPU; a training on the CPU has no figure of a GPU.
    memory = ", ".join(
        f"{size / 1e9:.1f} GB {where}"
        for where, size in (
            (name, numbers["peak_memory"].get(key)) for key, name in (("host", "of memory"), ("device", "on the GPU"))
        )
        if size
    )
    processes, tracking, pretraining = (
        numbers[name] for name in ("processes", "seconds_of_tracking", "seconds_of_pretraining")
    )
    parts = f", in {len(numbers['seams']) + 1} segments" if numbers.get("seams") else ""
    before = f" The surface was followed through the frames first, in {tracking:.0f} s{parts}." if tracking else ""
    before += f" The networks were pretrained without rendering, in {pretraining:.0f} s." if pretraining else ""
    return (
        f"{numbers['iterations_done']:,} of {numbers['iterations']:,} iterations on "
        f"{numbers['training_frames']} frames of {numbers['training_cameras']} cameras in "
        f"{numbers['seconds_of_steps']:.0f} s, {numbers['iterations_per_second']:.2f} a second"
        f"{f' by {processes} processes' if processes > 1 else ''}; at most {memory}.{before}{stopped}"
    )


def _files(numbers: Mapping[str, Any]) -> str:
    parts = numbers["parameters"]
    counted = ", ".join(f"{name.replace('_', ' ')} {count:,}" for name, count in parts.items() if name != "total")
    files = ", ".join(f"{name} {size / 1e6:.2f} MB" for name, size in numbers["bytes"].items())
    kept = numbers.get("compact", {}).get("kept_blend_shapes", 1.0)
    pruned = "" if kept == 1.0 else f" The compact file keeps the blend shapes of {100 * kept:.0f} % of the Gaussians."
    return f"{parts['total']:,} parameters: {counted}. Files: {files}.{pruned}"


def _table(numbers: Mapping[str, Any]) -> Table:
    states = [("start", numbers["start"]), (f"after {numbers['measured_at'] or 0:,} iterations", numbers)]
    if "compact" in numbers:
        states.append(("the compact file", numbers["compact"]))
    rows = tuple(
        (kind_name(kind, held_out=numbers["held_out_cameras"]), name, *(state[kind][key] for key in _FIGURES))
        for kind in KINDS
        for name, state in states
        if kind in state
    )
    return Table(
        ("views", "of", *_FIGURES.values()),
        rows,
        "means over the measured views; person: where mask or rendered opacity exceed 0.02",
    )


def _pictures(folder: Path) -> tuple[list[Picture], tuple[Comparison, ...]]:
    pictures, comparisons = [], []
    for strip in spread(sorted((folder / "previews").glob("*.png")), SHOWN_VIEWS):
        camera, frame = strip.stem.rsplit("_", 1)
        name, parts = f"{camera}, frame {int(frame)}", read_strip(strip)
        pictures.append(Picture(f"{name}: photograph, rendered, error", encode_png(row(list(parts)))))
        comparisons.append(
            Comparison(name, Picture("photograph", encode_png(parts[0])), Picture("rendered", encode_png(parts[1])))
        )
    return pictures, tuple(comparisons)


def _curves(lines: list[dict[str, Any]], *, held_out: bool) -> tuple[Curve, ...]:
    """Quality of the evaluations and loss of the steps, over the time spent in steps."""
    evaluations = [line for line in lines if line["kind"] == "evaluation"]
    steps = [line for line in lines if line["kind"] == "step" and "loss" in line]
    curves = []
    for key, title, unit in (("psnr", "PSNR", "dB"), ("ssim", "SSIM", "")):
        drawn = {}
        for kind in KINDS:
            there = [line for line in evaluations if kind in line]
            if len(there) > 1:
                x, y = ([value(line) for line in there] for value in (_seconds, lambda line: line[kind][key]))  # noqa: B023
                drawn[kind_name(kind, held_out=held_out)] = (np.array(x), np.array(y))
        if drawn:
            curves.append(Curve(title, drawn, "seconds", unit))
    if len(steps) > 1:
        groups = np.array_split(np.arange(len(steps)), min(CURVE_POINTS, len(steps)))
        mean = [
            [np.mean([value(steps[k]) for k in group]) for group in groups]
            for value in (_seconds, lambda line: line["loss"])
        ]
        curves.append(Curve("loss", {"training": (np.array(mean[0]), np.array(mean[1]))}, "seconds"))
    return tuple(curves)


def _seconds(line: Mapping[str, Any]) -> float:
    return line["seconds"]


_WHAT = (
    "The place of swinging cloth does not depend on the pose alone. Parts are simulated in new motion if their surface "
    "left skinning in the photographs and the simulation brings the person's outline nearer to the masks. The drag of "
    "the air and the depth of the pins were fitted to the surface that was tracked through the training frames, where "
    "the tracking was good enough."
)


def cloth_section(record: StageRecord) -> Section:
    """Show the calibrated cloth parameters of each part with their spread, and why others are left to the field."""
    numbers = record.manifest["numbers"]
    # One row for each examined part: errors of skinning and simulation, then the fitted parameters with their spread.
    rows = tuple(
        (
            part,
            "simulated" if part in numbers["loose"] else "left to the field",
            f"{one['skinned_mm']:.1f}",
            f"{one['simulated_mm']:.1f}" if one["moves"] else "-",
            *_outlines(one["outlines"]),
            _with_spread(one["drag_per_s"], one["drag_spread"]),
            _with_spread(one["pin_depth_mm"], one["pin_spread_mm"]),
            "-" if not one.get("quality") else f"{one['quality']['longest']:.2f}",
            "-" if not one.get("quality") else f"{1e3 * one['quality']['deepest']:.0f}",
            str(one["frames"]),
        )
        for part, one in numbers["calibration"].items()
    )
    columns = (
        "part",
        "",
        "skinning, mm",
        "simulation, mm",
        "outline, skinning",
        "simulation",
        "drag, 1/s",
        "pins, mm",
        "longest edge, x",
        "deepest, mm",
        "frames",
    )
    return Section(
        title="Loose clothes",
        text=(_WHAT, *numbers["notes"]),
        tables=(
            Table(
                columns,
                rows,
                "mm: to the tracked surface, vertex by vertex; outline: 1 - IoU with masks; +-: leaving frames out",
            ),
        ),
        checks=tuple(CheckRow.of(check, stage=record.folder.name) for check in record.manifest["checks"]),
    )


def _outlines(outlines: Mapping[str, Any] | None) -> tuple[str, str]:
    if outlines is None:
        return "-", "-"
    return f"{100 * outlines['skinned']:.1f} %", f"{100 * outlines['simulated']:.1f} %"


def _with_spread(value: float, spread: float | None) -> str:
    return "-" if spread is None else f"{value:.3g} +- {spread:.2g}"


def standing_refinement(run: Path, template_digest: str) -> StageRecord | None:
    """Return the record of a run's refinement; None without one, or for one on another template."""
    manifest = read_manifest(run / REFINE_STAGE)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != template_digest:
        return None
    return StageRecord(run / REFINE_STAGE, manifest, ran=False)


def refinement_key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    """Return the mean rotation and translation of the refinement for the head of the report."""
    found = record.manifest["numbers"]["training"]
    note = f"{np.mean(found['moved_mm']):.1f} mm of translation, {len(found['frames'])} frames"
    return (KeyNumber("poses refined by", f"{np.mean(found['turned_degrees']):.2f} degrees", note),)


def refine_section(record: StageRecord) -> Section:
    """Show the loss of every frame before and after, the change of the poses, and pictures of the worst frames."""
    numbers = record.manifest["numbers"]
    found = numbers["training"]
    frames = np.array(found["frames"])
    before, after = np.array(found["loss_before"]), np.array(found["loss_after"])
    # Curves over the frames show whether single frames or the whole sequence changed.
    curves = [
        Curve("loss of a frame", {"before": (frames, before), "after": (frames, after)}, "frame"),
        Curve(
            "turn of a joint, mean over the joints",
            {"turned": (frames, np.array(found["turned_degrees"]))},
            "frame",
            "degrees",
        ),
        Curve("shift of the translation", {"moved": (frames, np.array(found["moved_mm"]))}, "frame", "mm"),
    ]
    # Tiles are photograph, initial pose and refined pose.
    pictures, comparisons = [], []
    for shown in numbers["pictures"]:
        photograph, (start, refined) = read_tiles(path_inside(record.folder, shown["file"]), 2)
        pictures.append(
            Picture(f"{shown['title']}: photograph, before, after", encode_png(row([photograph, start, refined])))
        )
        comparisons.append(
            Comparison(
                f"{shown['title']}, before and after",
                Picture("before", encode_png(start)),
                Picture("after", encode_png(refined)),
            )
        )
    return Section(
        title="Poses",
        text=(_what(numbers), _kept(found)),
        pictures=tuple(pictures),
        comparisons=tuple(comparisons),
        tables=(_refinement_table(found),),
        curves=tuple(curves),
        checks=tuple(CheckRow.of(check, stage=REFINE_STAGE) for check in record.manifest["checks"]),
    )


def _what(numbers: dict[str, Any]) -> str:
    found = numbers["training"]
    text = (
        f"Pose, translation and expression of {len(found['frames'])} training frames were refined on the photographs "
        "of the training cameras, together with the colours of Gaussians on the template. Loose cloth is drawn and "
        "does not pull. The loss is 0 for a perfect picture and 1 for a wrong one, over the pixels of what sits firmly "
        f"on the body: {np.mean(found['loss_before']):.4f} before, {np.mean(found['loss_after']):.4f} after. The shape "
        "is the template's and stays."
    )
    # Held-out frames are reported apart: their poses saw the training cameras, and no training reads them.
    if "held_out" in numbers:
        apart = numbers["held_out"]
        text += (
            f" The {len(apart['frames'])} held-out frames were refined apart, into a file that no training reads: "
            f"{np.mean(apart['loss_before']):.4f} before, {np.mean(apart['loss_after']):.4f} after."
        )
    return text


def _kept(found: dict[str, Any]) -> str:
    kept = found["kept"]
    if not kept:
        return "Every frame fits its photographs better than before. The pictures show the frames that fit worst."
    return f"Frames {', '.join(map(str, kept))} keep their poses: refined ones fit their photographs worse."


def _refinement_table(found: dict[str, Any]) -> Table:
    most = sorted(found["joints"].items(), key=lambda item: -item[1])
    return Table(("joint", "turned, degrees"), tuple(most), "mean turn of each joint over the frames, the most first")
