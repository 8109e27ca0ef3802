"""Print the check of a capture: its findings, a line for each camera, and the worst frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pipelines.captures.check.report import check_as_dict
from smplxpp.capture.check.check import CaptureCheck
from smplxpp.capture.check.files import in_ranges
from smplxpp.capture.check.findings import Finding, grouped

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


def _camera_table(content: dict[str, Any]) -> Table:
    table = _table(("camera", "set"), ("images", "masks", "outside", "worst", "overlap"), ("fit",))
    for camera in content["cameras"]:
        fit = camera["fit"]
        figures = ("", "", "", Text("-", style="dim")) if fit is None else _figures(fit)
        table.add_row(camera["name"], camera["split"], str(camera["images"]), str(camera["masks"]), *figures)
    return table


def _frame_table(content: dict[str, Any], most: int = 8) -> Table:
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


def _table(left: tuple[str, ...], right: tuple[str, ...], last: tuple[str, ...]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
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
