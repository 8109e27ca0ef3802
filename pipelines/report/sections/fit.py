"""The report's section on a fit, from the files of its stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from avatar.training.engine.metrics_log import read_metrics
from pipelines.report import CheckRow, Comparison, Curve, KeyNumber, Picture, Section, Table
from pipelines.runs.layout import FIT_STAGE, TEMPLATE
from pipelines.runs.stage import StageRecord, read_manifest
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_numbers, shown
from smplxpp.core.files.paths import path_inside
from smplxpp.figures import encode_png, row
from smplxpp.figures.drawings import ERROR_LIMIT, error_legend, read_strip

HEAD_HEIGHT = 420
"""Pixels: crops of the head are enlarged by the whole number that brings them nearest to this."""
_FIGURES = ("psnr", "psnr_image", "ssim", "psnr_head")


def standing_fit(run: Path, template_digest: str) -> StageRecord | None:
    """Return the record of a run's fit; None without one, or for one of another template."""
    manifest = read_manifest(run / FIT_STAGE)
    if manifest is None or manifest["inputs"].get(TEMPLATE) != template_digest:
        return None
    return StageRecord(run / FIT_STAGE, manifest, ran=False)


def fit_key_numbers(record: StageRecord) -> tuple[KeyNumber, ...]:
    """Return the key numbers of the fit for the head of the report."""
    numbers = record.manifest["numbers"]
    which, names = _shown(numbers)
    figures = numbers["mean"][which]
    note = f"{'novel' if which == 'held_out' else 'training'} views ({len(names)}), SSIM {figures['ssim']:.3f}"
    return (KeyNumber("one frame's Gaussians: PSNR of the person", f"{figures['psnr']:.1f} dB", note),)


def fit_section(record: StageRecord) -> Section:
    """Show photograph, rendering and error side by side, figures by camera, and quality over time."""
    numbers = record.manifest["numbers"]
    which, names = _shown(numbers)
    # A strip holds photograph, rendering and error of one camera. A missing one is skipped: strips are previews only.
    pictures, comparisons = [], []
    for name in names:
        strip = path_inside(record.folder, f"previews/{name}.png")
        if not strip.is_file():
            continue
        parts = read_strip(strip)
        pictures.append(Picture(f"{name}: photograph, rendered, error", encode_png(row(list(parts)))))
        comparisons.append(
            Comparison(
                f"{name}, every pixel",
                Picture("photograph", encode_png(parts[0])),
                Picture("rendered", encode_png(parts[1])),
            )
        )
        # The head is shown enlarged, because faces are judged by it.
        head = numbers["heads"].get(name)
        if head is not None:
            pictures.append(_head_picture(name, parts, head))
    kind = "held out" if which == "held_out" else "trained on: no camera is held out"
    return Section(
        title="Gaussians",
        text=(
            f"{numbers['gaussians']:,} Gaussians bound to the template's triangles, fitted to one frame's photographs. "
            f"The cameras shown were {kind}. Error: the largest difference of a colour channel at a pixel, "
            f"from 0 (pale) to {ERROR_LIMIT} of 255 and more (dark).",
            f"{numbers['iterations_done']:,} of {numbers['iterations']:,} iterations in "
            f"{numbers['seconds_of_steps']:.0f} s, {numbers['iterations_per_second']:.1f} a second. "
            f"{FIT_STAGE}/splats.ply holds the splats of this pose in the layout of 3D Gaussian Splatting, "
            f"{FIT_STAGE}/gaussians.safetensors holds them bound to the triangles.",
            numbers["convention"],
        ),
        pictures=(*pictures, Picture(f"error, of 255: 0 to {ERROR_LIMIT} and more", encode_png(error_legend()))),
        comparisons=tuple(comparisons),
        curves=_curves(record.folder / "metrics.jsonl"),
        tables=(_table(numbers),),
        checks=tuple(CheckRow.of(check, stage=FIT_STAGE) for check in record.manifest["checks"]),
    )


def _shown(numbers: dict[str, Any]) -> tuple[str, list[str]]:
    """Return the kind and names of the views to show: held-out ones, or training views where none is held out."""
    which = "held_out" if numbers["held_out"] else "train"
    return which, list(numbers[which])


def _head_picture(name: str, parts: tuple[UInt8[np.ndarray, "H W 3"], ...], box: Any) -> Picture:
    x0, y0, x1, y1 = head_box(box, parts[0])
    # Enlarge by whole numbers, so that pixels stay sharp squares.
    factor = max(1, round(HEAD_HEIGHT / (y1 - y0)))
    crops = encode_png(row([part[y0:y1, x0:x1] for part in parts], gap=1))
    return Picture(f"{name}, head, {factor} times enlarged: photograph, rendered, error", crops, enlarged=factor)


def head_box(value: Any, image: UInt8[np.ndarray, "H W 3"]) -> tuple[int, int, int, int]:
    """Parse the box of a head from a manifest: left, top, right and bottom in pixels.

    Raises:
        InputError: other values, a box outside of the picture, or one more than 8 times as wide as high.
    """
    x0, y0, x1, y1 = (int(number) for number in as_numbers(value, (4,), subject="head in a picture"))
    height, width = image.shape[:2]
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height and x1 - x0 <= 8 * (y1 - y0)):
        raise InputError("head in a picture", expected=f"a box within {width} x {height}", received=shown(value))
    return x0, y0, x1, y1


def _table(numbers: dict[str, Any]) -> Table:
    rows = []
    for which, label in (("held_out", "held out"), ("train", "training")):
        for name, figures in numbers[which].items():
            rows.append((name, label, *(figures[key] for key in _FIGURES)))
        if numbers[which]:
            rows.append(("mean", label, *(numbers["mean"][which].get(key) for key in _FIGURES)))
    header = ("camera", "views", "PSNR of the person, dB", "of the image", "SSIM", "PSNR of the head, dB")
    return Table(header, tuple(rows), "figures by camera")


def _curves(path: Path) -> tuple[Curve, ...]:
    """Return curves of PSNR and SSIM over the seconds spent in steps; none for fewer than two evaluations."""
    # The log has lines of steps too; evaluations alone measure whole views.
    found = [entry for entry in read_metrics(path) if entry["kind"] == "evaluation"]
    if len(found) < 2:
        return ()
    seconds = np.array([entry["seconds"] for entry in found])
    lines = {
        title: (seconds, np.array([entry["mean"][key] for entry in found], dtype=np.float64))
        for key, title in (("psnr", "person"), ("psnr_head", "head"))
        if all(entry["mean"].get(key) is not None for entry in found)
    }
    # A capture that holds nothing out is evaluated on training views, and the title states it.
    which = "novel" if found[0]["held_out"] else "training"
    ssim = {"whole image": (seconds, np.array([entry["mean"]["ssim"] for entry in found]))}
    return (
        Curve(f"PSNR of the {which} views", lines, "seconds", "dB"),
        Curve(f"SSIM of the {which} views", ssim, "seconds"),
    )
