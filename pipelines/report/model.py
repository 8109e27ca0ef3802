"""Content of a report: sections, tables, charts and checks. The builder only lays them out."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Num

from pipelines.runs.folders import STATUSES, require_check
from smplxpp.core import Check, InputError


@dataclass(frozen=True)
class CheckRow:
    """A check as a manifest records it.

    Attributes:
        value: measured value; None where it was not finite, because JSON has no such numbers.
        gate: the gate as text.
        stage: folder of the stage that made the check.
    """

    name: str
    value: float | None
    unit: str
    status: str
    gate: str
    explanation: str = ""
    stage: str = ""

    def __post_init__(self) -> None:
        if self.status not in STATUSES:
            raise InputError(f"status of {self.name!r}", expected=f"one of {', '.join(STATUSES)}", received=self.status)

    @staticmethod
    def of(check: Check | Mapping[str, Any], *, stage: str = "") -> CheckRow:
        """Make a row of a `Check`, or of its record in a manifest or in metrics.json."""
        record = check.as_dict() if isinstance(check, Check) else require_check(check, subject="record of a check")
        value = record.get("value")
        return CheckRow(
            name=str(record["name"]),
            value=float(value) if value is not None and math.isfinite(value) else None,
            unit=str(record.get("unit", "")),
            status=str(record["status"]),
            gate=str(record.get("gate", "")),
            explanation=str(record.get("explanation", "")),
            stage=str(record.get("stage", stage)),
        )

    @property
    def shown(self) -> str:
        """Return the value as text with its unit."""
        return "not a number" if self.value is None else f"{format_value(self.value)} {self.unit}".strip()


@dataclass(frozen=True)
class Picture:
    """An encoded picture (PNG, JPEG or WebP) with its caption.

    Attributes:
        alt: text that is read aloud; by default the caption.
        enlarged: side of the square, in pixels of the page, that shows a pixel of the picture.
    """

    caption: str
    data: bytes
    alt: str = ""
    enlarged: int = 1


@dataclass(frozen=True)
class Film:
    """An MP4 film with its caption, shown with the browser's controls.

    Raises:
        InputError: other bytes.
    """

    caption: str
    data: bytes

    def __post_init__(self) -> None:
        if self.data[4:8] != b"ftyp":
            raise InputError(f"film {self.caption!r}", expected="MP4 bytes", received=repr(self.data[:8]))

    @property
    def uri(self) -> str:
        """Return the film as a data URI."""
        return f"data:video/mp4;base64,{base64.b64encode(self.data).decode()}"


@dataclass(frozen=True)
class Comparison:
    """Two pictures of one size, laid on each other with a slider between them."""

    caption: str
    before: Picture
    after: Picture


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers; numbers are formatted and right-aligned."""

    header: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise InputError(
                    f"table {self.caption!r}", expected=f"{len(self.header)} cells a row", received=str(len(row))
                )


@dataclass(frozen=True, eq=False)
class Histogram:
    """Histogram of a distribution with its gates.

    Attributes:
        title: title of the picture.
        values: samples of the distribution; values that are not finite are counted and not drawn.
        unit: unit of the values.
        gates: (label, value) drawn as dashed lines.
        upper: end of the axis; larger values are counted in the last bar. By default the 99.5th percentile, with gates.
    """

    title: str
    values: Num[np.ndarray, "*shape"]
    unit: str = "mm"
    gates: tuple[tuple[str, float], ...] = ()
    upper: float | None = None


@dataclass(frozen=True, eq=False)
class Curve:
    """Quantities over one axis, a line each.

    Attributes:
        title: title of the picture.
        lines: name -> (x, y), x ascending; points that are not finite are left out.
        x_label: label of the x axis.
        unit: unit of the y axis.
    """

    title: str
    lines: Mapping[str, tuple[Num[np.ndarray, " N"], Num[np.ndarray, " N"]]]
    x_label: str
    unit: str = ""


@dataclass(frozen=True)
class KeyNumber:
    """A number for the head of the report, already formatted."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Use:
    """Something that a run can be used for, with the checks that decide it.

    Attributes:
        purpose: completes "can be used to".
        status: `pass`, `warn` or `fail`, the worst of the checks.
        words: what was found.
    """

    purpose: str
    status: str
    words: str


@dataclass(frozen=True)
class Step:
    """A command that is likely to come next, with what it is for."""

    purpose: str
    command: str


@dataclass(frozen=True)
class Section:
    """Section of the report on one stage or topic.

    Attributes:
        text: paragraphs, plain text.
        legend: (name, sRGB) pairs for the pictures' colours.
        checks: the section's checks, shown at its end.
    """

    title: str
    text: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    films: tuple[Film, ...] = ()
    tables: tuple[Table, ...] = ()
    histograms: tuple[Histogram, ...] = ()
    curves: tuple[Curve, ...] = ()
    legend: tuple[tuple[str, tuple[int, int, int]], ...] = ()
    checks: tuple[CheckRow, ...] = ()


@dataclass(frozen=True)
class Report:
    """Content of a whole report.

    Attributes:
        subject: name of the run's person.
        summary: one or two sentences.
        uses: what the run can be used for, and what stands against it; the first thing that a reader sees.
        steps: what to do next.
        hero: pictures beside the title.
        checks: all checks of the run; the verdict counts them.
        seconds: wall-clock seconds by stage, in order.
        provenance: title -> {key: value}: configuration, versions, seeds, SHA-256 of the inputs.
        kind: kind of the report, in a word.
    """

    subject: str
    summary: str = ""
    uses: tuple[Use, ...] = ()
    steps: tuple[Step, ...] = ()
    hero: tuple[Picture, ...] = ()
    key_numbers: tuple[KeyNumber, ...] = ()
    checks: tuple[CheckRow, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    sections: tuple[Section, ...] = ()
    provenance: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    kind: str = "template"


def count_statuses(checks: Iterable[CheckRow]) -> dict[str, int]:
    """Count the checks that fail, warn and pass."""
    statuses = [check.status for check in checks]
    return {status: statuses.count(status) for status in STATUSES}


def worst_status(checks: Iterable[CheckRow]) -> str:
    """Return `fail`, `warn` or `pass`; `pass` for no checks."""
    present = {check.status for check in checks}
    return next((status for status in STATUSES if status in present), "pass")


def format_value(value: Any) -> str:
    """Write a number for readers: three to four significant digits, thousands separated; other values as text."""
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}"
    return _format_float(float(value)) if isinstance(value, float | np.floating) else str(value)


def _format_float(value: float) -> str:
    if not math.isfinite(value):
        return "not a number" if math.isnan(value) else ("∞" if value > 0 else "-∞")
    if value == 0:
        return "0"
    # Exponents outside 1e-3 to 1e7; whole numbers from 1000; otherwise three significant digits, four from 100.
    size = abs(value)
    if size < 1e-3 or size >= 1e7:
        return f"{value:.2e}"
    if size >= 1000:
        return f"{value:,.0f}"
    return (
        f"{value:.{max(0, 2 - math.floor(math.log10(size)))}f}".rstrip("0").rstrip(".")
        if size < 100
        else f"{value:.4g}"
    )
