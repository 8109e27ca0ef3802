"""Report the check of a capture: a page, a sheet of pictures, a summary in the terminal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from rich.console import Console
from rich.table import Table as TextTable
from rich.text import Text
from scipy import ndimage

from pipelines.report import CheckRow, Curve, KeyNumber, Picture, Report, Section, Table, write_report
from pipelines.runs.code import versions
from smplxpp.capture.check.check import CaptureCheck
from smplxpp.capture.check.findings import AREAS, Finding, grouped
from smplxpp.capture.check.views import OPAQUE, OUTSIDE_BAD, OUTSIDE_DOUBTFUL, FitSummary, ViewCheck, body_silhouette
from smplxpp.capture.check.without_images import in_ranges
from smplxpp.core import InputError, spread
from smplxpp.core.files import atomic_write_bytes, atomic_write_text, jsonable
from smplxpp.figures import caption, contact_sheet, encode_jpeg, encode_png, row

_STYLES = {"fail": "red", "warn": "yellow", "good": "green", "doubtful": "yellow", "bad": "red"}


def print_check(check: CaptureCheck, console: Console) -> None:
    """Print all findings of a check with the figures behind them."""
    content = check_as_dict(check)
    _print_head(check, content, console)
    console.print(_camera_table(content))
    frames = _frame_table(content)
    if frames.row_count:
        console.print()
        console.print(frames)
    # Findings of one kind are printed together, with one remedy.
    for group in grouped(check.findings):
        console.print()
        _print_group(group, console)
    # End with the number of failures and warnings.
    counts = [sum(finding.status == status for finding in check.findings) for status in ("fail", "warn")]
    console.print()
    if not any(counts):
        console.print(Text("no complaint", style="green"))
    else:
        console.print(Text(f"{counts[0]} to correct", style="red" if counts[0] else "dim"), end="  ")
        console.print(Text(f"{counts[1]} to look at", style="yellow" if counts[1] else "dim"))


def _print_head(check: CaptureCheck, content: dict[str, Any], console: Console) -> None:
    sizes = sorted({f"{camera['width']} x {camera['height']}" for camera in content["cameras"]})
    rate = f" at {content['fps']:g} a second" if content["fps"] else ""
    console.print(Text(content["name"], style="bold") + Text(f"  {content['capture']}", style="dim"), soft_wrap=True)
    console.print(
        f"layout {content['format']}; {len(content['cameras'])} cameras, {', '.join(sizes)}; "
        f"{content['frames']} frames{rate}",
        highlight=False,
    )
    # What training sees and what is held out.
    splits = check.capture.splits
    cameras, frames = ", ".join(splits.novel_view_cameras), in_ranges(np.array(splits.novel_pose_frames, dtype=int))
    held = " and ".join(f"{what} {names}" for what, names in (("cameras", cameras), ("frames", frames)) if names)
    console.print(
        f"trained on {len(splits.train_cameras)} cameras and {len(splits.train_frames)} frames; held out: "
        + (held or "nothing, so that nothing can be measured on what was not trained on"),
        highlight=False,
        soft_wrap=True,
    )
    if content["opened_frames"] < content["frames"]:
        console.print(
            f"opened the images of {content['opened_frames']} frames, evenly spread; `--frames all` opens all",
            highlight=False,
        )
    console.print()


def _camera_table(content: dict[str, Any]) -> TextTable:
    table = _table(("camera", "set"), ("images", "masks", "outside", "worst", "overlap"), ("fit",))
    for camera in content["cameras"]:
        fit = camera["fit"]
        figures = ("", "", "", Text("-", style="dim")) if fit is None else _figures(fit)
        table.add_row(camera["name"], camera["split"], str(camera["images"]), str(camera["masks"]), *figures)
    return table


def _frame_table(content: dict[str, Any], most: int = 8) -> TextTable:
    """List the frames that do not fit well, worst first."""
    table = _table(("frame",), ("bad views", "outside", "worst", "overlap"), ("fit",))
    doubtful = [(frame, fit) for frame, fit in content["frame_fits"].items() if fit["verdict"] != "good"]
    doubtful.sort(key=lambda item: -item[1]["outside"])
    for frame, fit in doubtful[:most]:
        table.add_row(frame, f"{fit['bad']}/{fit['views']}", *_figures(fit))
    if len(doubtful) > most:
        table.add_row(Text(f"and {len(doubtful) - most} more", style="dim"))
    return table


def _print_group(group: tuple[Finding, ...], console: Console, most: int = 6) -> None:
    first = group[0]
    count = f" ({len(group)})" if len(group) > 1 else ""
    console.print(Text(f"{first.status}  ", style=_STYLES[first.status]) + Text(f"{first.kind}{count}", style="bold"))
    for finding in group[:most]:
        console.print(Text(f"  {finding.message}"), soft_wrap=True)
    if len(group) > most:
        console.print(Text(f"  and {len(group) - most} more (--json lists all)", style="dim"))
    console.print(Text("  do: ", style="cyan") + Text(first.remedy), soft_wrap=True)


def _table(left: tuple[str, ...], right: tuple[str, ...], last: tuple[str, ...]) -> TextTable:
    table = TextTable(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for name in left:
        table.add_column(name)
    for name in right:
        table.add_column(name, justify="right")
    for name in last:
        table.add_column(name)
    return table


def _figures(fit: dict[str, Any]) -> tuple[str, str, str, Text]:
    verdict = Text(fit["verdict"], style=_STYLES[fit["verdict"]])
    return f"{fit['outside']:.1%}", f"{fit['worst']:.1%}", f"{fit['iou']:.2f}", verdict


_BODY_COLOR, _MASK_COLOR = (255, 60, 140), (0, 210, 255)


def check_as_dict(check: CaptureCheck) -> dict[str, Any]:
    """Return the whole check as JSON values."""
    # Figures by camera, then by frame, then the findings.
    capture = check.capture
    images, masks = capture.presence(), capture.presence("mask")
    fits, splits = check.cameras(), capture.splits
    cameras = [
        {
            "name": name,
            "width": camera.width,
            "height": camera.height,
            "split": _split(check, name),
            "images": int(images[k].sum()),
            "masks": int(masks[k].sum()),
            "fit": _fit(fits.get(name)),
        }
        for k, (name, camera) in enumerate(capture.cameras.items())
    ]
    return {
        "capture": str(capture.root),
        "name": capture.name,
        "format": capture.format,
        "fps": capture.fps,
        "frames": len(capture.frames),
        "opened_frames": len(check.frames),
        "opened_views": len(check.views),
        "splits": {
            "train_cameras": len(splits.train_cameras),
            "novel_view_cameras": len(splits.novel_view_cameras),
            "train_frames": len(splits.train_frames),
            "novel_pose_frames": len(splits.novel_pose_frames),
        },
        "cameras": cameras,
        "frame_fits": {str(frame): _fit(fit) for frame, fit in check.frame_fits().items()},
        "findings": [finding.as_dict() for finding in check.findings],
        "failed": check.failed,
    }


def write_check_report(check: CaptureCheck, folder: Path) -> Path:
    """Write `report.html`, `contact_sheet.png` and `check.json` to the folder; returns the report's path."""
    atomic_write_text(folder / "check.json", json.dumps(jsonable(check_as_dict(check)), indent=1) + "\n")
    strips = _strips(check)
    # Several strips lie beside each other where there are many.
    if strips:
        atomic_write_bytes(
            folder / "contact_sheet.png",
            encode_png(contact_sheet(list(strips.values()), columns=max(1, round(len(strips) ** 0.5 / 2)), gap=8)),
        )
    pictures = tuple(Picture(camera, encode_jpeg(strip)) for camera, strip in strips.items())
    return write_report(folder / "report.html", _report(check, pictures))


def _strips(check: CaptureCheck) -> dict[str, UInt8[np.ndarray, "_ _ 3"]]:
    """Draw four frames of each camera beside each other, for at most 24 cameras, evenly spread."""
    frames = spread(check.frames, 4)
    known = {(view.camera, view.frame): view for view in check.views}
    strips = {}
    for camera in spread(list(dict.fromkeys(view.camera for view in check.views)), 24):
        cells = [
            caption(
                _widened(_cell(check, camera, frame)), _cell_caption(known.get((camera, frame)), camera, frame), size=13
            )
            for frame in frames
        ]
        strips[camera] = row(cells, gap=8)
    return strips


def _widened(cell: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H w 3"]:
    """Pad a cell with white to the width of its caption."""
    missing = max(0, 190 - cell.shape[1])
    return np.pad(cell, ((0, 0), (missing // 2, missing - missing // 2), (0, 0)), constant_values=255)


def _cell(check: CaptureCheck, camera: str, frame: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw one view with both outlines at the sheet's height."""
    small, full = check.small, check.small.cameras[camera]
    try:
        image = np.array(small.image(camera, frame))
        mask = small.mask(camera, frame)
    except InputError:
        image, mask = np.full((full.height, full.width, 3), 190, np.uint8), None
    height = min(300, full.height)
    size = (max(1, round(full.width * height / full.height)), height)
    cell = np.array(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))
    outlines = [] if mask is None else [(mask > OPAQUE, _MASK_COLOR)]
    vertices = check.vertices(frame)
    if vertices is not None:
        outlines.append((body_silhouette(vertices, check.faces, full), _BODY_COLOR))
    # An outline is a shape without its erosion.
    for shape, color in outlines:
        reduced = np.array(Image.fromarray(shape).resize(size, Image.Resampling.NEAREST))
        cell[reduced & ~ndimage.binary_erosion(reduced, border_value=1)] = color
    return cell


def _cell_caption(view: ViewCheck | None, camera: str, frame: int) -> str:
    if view is None:
        return f"{camera}, {frame}: no image"
    return f"{camera}, {frame}" + (f": {view.fit.outside:.1%} outside" if view.fit else "")


def _report(check: CaptureCheck, pictures: tuple[Picture, ...]) -> Report:
    capture = check.capture
    fits = check.cameras()
    numbers = [KeyNumber("cameras", str(len(capture.cameras))), KeyNumber("frames", f"{len(capture.frames):,}")]
    # The key number is the median over cameras of the body's share outside the mask.
    if fits:
        outside = float(np.median([fit.outside for fit in fits.values()]))
        numbers.append(KeyNumber("body outside the masks", f"{outside:.1%}", "median of the cameras"))
    return Report(
        kind="capture",
        subject=capture.name,
        summary=f"Layout {capture.format}, {len(check.views):,} views of {len(check.frames):,} frames opened.",
        key_numbers=tuple(numbers),
        checks=tuple(_check_row(check, area) for area in AREAS),
        sections=(
            _findings_section(check),
            _silhouette_section(check, pictures),
            _frame_section(check),
        ),
        provenance={"capture": {"folder": str(capture.root), "format": capture.format}, "versions": versions()},
    )


def _check_row(check: CaptureCheck, area: str) -> CheckRow:
    own = [finding for finding in check.findings if finding.area == area]
    failures = sum(finding.status == "fail" for finding in own)
    status = "fail" if failures else ("warn" if own else "pass")
    return CheckRow(area, float(len(own)), "findings", status, "none", stage="capture")


def _findings_section(check: CaptureCheck, most: int = 12) -> Section:
    table = []
    for group in grouped(check.findings):
        messages = [finding.message for finding in group[:most]]
        if len(group) > most:
            messages.append(f"and {len(group) - most} more, in check.json")
        table.append((group[0].status, group[0].kind, len(group), "; ".join(messages), group[0].remedy))
    text = () if table else ("Nothing to complain about.",)
    tables = (Table(("status", "kind", "count", "what", "do"), tuple(table)),) if table else ()
    return Section("Findings", text=text, tables=tables)


def _silhouette_section(check: CaptureCheck, pictures: tuple[Picture, ...]) -> Section:
    fits = check.cameras()
    rows = []
    # One row a camera, also without a fit.
    for name in check.capture.cameras:
        fit = fits.get(name)
        figures = (None,) * 4 if fit is None else (100 * fit.outside, 100 * fit.worst, fit.iou, fit.bad)
        rows.append((name, _split(check, name), *figures, "-" if fit is None else fit.verdict))
    header = ("camera", "set", "outside, median %", "outside, worst %", "overlap", "bad views", "verdict")
    return Section(
        title="Body against masks",
        text=(
            "The body, posed with each frame's parameters, is projected through each camera. Outside: the share of its "
            f"pixels that the mask leaves out; below {OUTSIDE_DOUBTFUL:.0%} is good, above {OUTSIDE_BAD:.0%} something "
            "is wrong. Overlap: intersection over union; clothes and hair make the mask larger than the body.",
        ),
        pictures=pictures,
        tables=(Table(header, tuple(rows), "figures by camera"),),
        legend=(("posed body", _BODY_COLOR), ("mask", _MASK_COLOR)),
    )


def _frame_section(check: CaptureCheck) -> Section:
    fits = check.frame_fits()
    rows = tuple(
        (frame, fit.views, 100 * fit.outside, 100 * fit.worst, fit.iou, fit.bad, fit.verdict)
        for frame, fit in spread(list(fits.items()), 200)
    )
    header = ("frame", "views", "outside, median %", "outside, worst %", "overlap", "bad views", "verdict")
    # A curve needs two frames.
    curves: tuple[Curve, ...] = ()
    if len(fits) > 1:
        numbers = np.array(list(fits))
        lines = {
            "median": (numbers, np.array([100 * fit.outside for fit in fits.values()])),
            "worst": (numbers, np.array([100 * fit.worst for fit in fits.values()])),
        }
        curves = (Curve("share of the body outside the masks", lines, "frame", "%"),)
    return Section("By frame", curves=curves, tables=(Table(header, rows, "figures by frame"),))


def _split(check: CaptureCheck, camera: str) -> str:
    splits = check.capture.splits
    if camera in splits.train_cameras:
        return "train"
    return "novel view" if camera in splits.novel_view_cameras else "-"


def _fit(fit: FitSummary | None) -> dict[str, Any] | None:
    return None if fit is None else {**vars(fit), "verdict": fit.verdict}
