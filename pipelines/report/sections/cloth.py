"""The report's section of the loose clothes: which are simulated, and how they were fitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipelines.report import CheckRow, Section, Table
from pipelines.runs.stage import StageRecord

_WHAT = (
    "Cloth that swings cannot be read off a pose. Parts whose surface left skinning in the photographs, and with which "
    "simulated the person's outline is nearer to the masks, are simulated in new motion: the drag of the air and the "
    "depth to which the body holds them were fitted to the surface that the teacher followed through the training "
    "frames, where that was followed well enough to say."
)


def cloth_section(record: StageRecord) -> Section:
    """Parts, what was fitted to them with its uncertainty, and why the others were left to the field."""
    numbers = record.manifest["numbers"]
    rows = tuple(
        (
            part,
            "simulated" if part in numbers["loose"] else "left to the field",
            f"{one['skinned_mm']:.1f}",
            f"{one['simulated_mm']:.1f}" if one["moves"] else "-",
            *_outlines(one["outlines"]),
            _with_spread(one["drag_per_s"], one["drag_spread"]),
            _with_spread(one["pin_depth_mm"], one["pin_spread_mm"]),
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
        "frames",
    )
    return Section(
        title="Loose clothes",
        text=(_WHAT, *numbers["said"]),
        tables=(
            Table(
                columns,
                rows,
                "mm: to the followed surface, vertex by vertex; outline: 1 - IoU with masks; +-: leaving frames out",
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
