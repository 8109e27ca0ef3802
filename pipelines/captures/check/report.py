"""The check as files: report.html, contact_sheet.png, check.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.captures.check.pictures import BODY_COLOR, MASK_COLOR, contact_sheet_of, draw_strips
from pipelines.figures import encode_jpeg, encode_png
from pipelines.report import CheckRow, Curve, KeyNumber, Picture, Report, Section, Table, write_report
from pipelines.runs.code import versions
from smplxpp.capture.check.check import CaptureCheck
from smplxpp.capture.check.findings import AREAS, grouped
from smplxpp.capture.check.silhouettes import OUTSIDE_BAD, OUTSIDE_DOUBTFUL, FitSummary
from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text
from smplxpp.core.files.json_file import jsonable
from smplxpp.core.spread import spread

SHOWN_MESSAGES, SHOWN_FRAMES = 12, 200


def check_as_dict(check: CaptureCheck) -> dict[str, Any]:
    """Return everything that was found as JSON values."""
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
    strips = draw_strips(check)
    if strips:
        atomic_write_bytes(folder / "contact_sheet.png", encode_png(contact_sheet_of(strips)))
    pictures = tuple(Picture(camera, encode_jpeg(strip)) for camera, strip in strips.items())
    return write_report(folder / "report.html", _report(check, pictures))


def _report(check: CaptureCheck, pictures: tuple[Picture, ...]) -> Report:
    capture = check.capture
    fits = check.cameras()
    numbers = [KeyNumber("cameras", str(len(capture.cameras))), KeyNumber("frames", f"{len(capture.frames):,}")]
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


def _findings_section(check: CaptureCheck) -> Section:
    table = []
    for group in grouped(check.findings):
        messages = [finding.message for finding in group[:SHOWN_MESSAGES]]
        if len(group) > SHOWN_MESSAGES:
            messages.append(f"and {len(group) - SHOWN_MESSAGES} more, in check.json")
        table.append((group[0].status, group[0].kind, len(group), "; ".join(messages), group[0].remedy))
    text = () if table else ("Nothing to complain about.",)
    tables = (Table(("status", "kind", "count", "what", "do"), tuple(table)),) if table else ()
    return Section("Findings", text=text, tables=tables)


def _silhouette_section(check: CaptureCheck, pictures: tuple[Picture, ...]) -> Section:
    fits = check.cameras()
    rows = []
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
        legend=(("posed body", BODY_COLOR), ("mask", MASK_COLOR)),
    )


def _frame_section(check: CaptureCheck) -> Section:
    fits = check.frame_fits()
    rows = tuple(
        (frame, fit.views, 100 * fit.outside, 100 * fit.worst, fit.iou, fit.bad, fit.verdict)
        for frame, fit in spread(list(fits.items()), SHOWN_FRAMES)
    )
    header = ("frame", "views", "outside, median %", "outside, worst %", "overlap", "bad views", "verdict")
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
