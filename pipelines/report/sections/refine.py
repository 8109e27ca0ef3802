"""The report's section on refined poses, from the files of their stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipelines.figures import encode_png, row
from pipelines.figures.comparison import read_tiles
from pipelines.report import CheckRow, Comparison, Curve, KeyNumber, Picture, Section, Table
from pipelines.runs.layout import REFINE_STAGE, TEMPLATE
from pipelines.runs.stage import StageRecord, read_manifest
from smplxpp.core.files.paths import path_inside


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
        tables=(_table(found),),
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


def _table(found: dict[str, Any]) -> Table:
    most = sorted(found["joints"].items(), key=lambda item: -item[1])
    return Table(("joint", "turned, degrees"), tuple(most), "mean turn of each joint over the frames, the most first")
