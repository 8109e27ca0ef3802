"""The report's section of the loose clothes: which are simulated, and how they were fitted."""

from __future__ import annotations

from pipelines.report import CheckRow, Section, Table
from pipelines.runs.stage import StageRecord

_WHAT = (
    "Cloth that swings cannot be read off a pose. Parts whose surface left skinning in the photographs, and that a "
    "simulation brings nearer to that surface, are simulated in new motion: the drag of the air and the depth to which "
    "the body holds them were fitted to the surface that the teacher followed through the training frames."
)


def cloth_section(record: StageRecord) -> Section:
    """Parts, what was fitted to them with its uncertainty, and why the others were left to the field."""
    numbers = record.manifest["numbers"]
    rows = tuple(
        (
            part,
            "simulated" if part in numbers["loose"] else "left to the field",
            f"{one['skinned_mm']:.1f}",
            f"{one['simulated_mm']:.1f}" if part in numbers["loose"] else "-",
            _with_spread(one["drag_per_s"], one["drag_spread"]),
            _with_spread(one["pin_depth_mm"], one["pin_spread_mm"]),
            str(one["frames"]),
        )
        for part, one in numbers["calibration"].items()
    )
    columns = ("part", "", "skinning, mm", "simulation, mm", "drag, 1/s", "pins, mm", "frames")
    return Section(
        title="Loose clothes",
        text=(_WHAT, *numbers["said"]),
        tables=(Table(columns, rows, "distances to the followed surface, vertex by vertex; +- by leaving frames out"),),
        checks=tuple(CheckRow.of(check, stage=record.folder.name) for check in record.manifest["checks"]),
    )


def _with_spread(value: float, spread: float | None) -> str:
    return "-" if spread is None else f"{value:.3g} +- {spread:.2g}"
