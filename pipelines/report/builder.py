"""Lay out a `Report` as one self-contained HTML file, without network, fonts or other files."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from pipelines.report.charts import curve_svg, histogram_statistics, histogram_svg, timings_svg
from pipelines.report.model import (
    STATUSES,
    CheckRow,
    Curve,
    Histogram,
    KeyNumber,
    Report,
    Section,
    count_statuses,
    format_value,
    worst_status,
)
from pipelines.runs.artefacts import values_of
from pipelines.runs.stage import StageRecord
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.files.atomic import atomic_write_text

_VERDICTS = {
    "pass": "Every check passes",
    "warn": "Usable, with warnings",
    "fail": "Some checks fail",
}


def write_report(path: str | Path, report: Report) -> Path:
    """Write `report` to `path` as one self-contained HTML file, whole or not at all."""
    folder = resources.files("pipelines.report")
    # Escape all text, since names of files and cameras come from users; an unknown variable of the template is an
    # error.
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
    )
    environment.filters |= {"value": format_value, "flat": _flatten, "worst": worst_status}
    environment.tests["number"] = _is_number
    # Charts are drawn as SVG within the page while the template is rendered.
    environment.globals |= {
        "histogram_svg": _histogram,
        "curve_svg": _curve,
        "timings_svg": _timings,
        "statistics": histogram_statistics,
    }
    worst = worst_status(report.checks)
    html = environment.get_template("report.html.j2").render(
        report=report,
        counts=count_statuses(report.checks),
        worst=worst,
        verdict=_VERDICTS[worst] if report.checks else "No checks were made",
        # List the checks that failed or warned first; STATUSES is ordered from the worst on.
        attention=sorted(
            (check for check in report.checks if check.status != "pass"), key=lambda c: STATUSES.index(c.status)
        ),
        by_stage=_by_stage(report.checks),
        total_seconds=sum(report.seconds.values()),
    )
    atomic_write_text(path, html)
    return Path(path)


def _by_stage(checks: tuple[CheckRow, ...]) -> dict[str, list[CheckRow]]:
    out: dict[str, list[CheckRow]] = {}
    for check in checks:
        out.setdefault(check.stage, []).append(check)
    return out


def _histogram(histogram: Histogram) -> Markup:
    return Markup(histogram_svg(histogram))


def _curve(curve: Curve) -> Markup:
    return Markup(curve_svg(curve))


def _timings(seconds: Mapping[str, float]) -> Markup:
    return Markup(timings_svg(seconds))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _flatten(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the rows (dotted key, value) of nested mappings."""
    rows: list[tuple[str, Any]] = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        rows += _flatten(value, f"{name}.") if isinstance(value, Mapping) else [(name, value)]
    return rows


def readable(record: StageRecord, title: str, make: Callable[[], Section]) -> Section:
    """Make a section from a stage's files, or one with the error message where they cannot be read.

    Files of a stage that ran in this call must be readable, so that their errors are raised.

    Args:
        record: the stage.
        title: title of the section in case of an error.
        make: function that makes the section.

    Raises:
        InputError: unreadable files of a stage that ran in this call.
    """
    try:
        with values_of(record), np.errstate(over="raise", divide="raise", invalid="raise"):
            # Draw all charts here too, so that values which cannot be drawn are caught with the rest.
            section = make()
            for curve in section.curves:
                curve_svg(curve)
            for histogram in section.histograms:
                histogram_svg(histogram)
            return section
    except InputError as error:
        if record.ran:
            raise
        # One damaged stage must not cost the page of all others: show the message and the checks instead.
        message = f"{record.folder.name} cannot be read: {error}"
        warnings.warn(f"report: {message}", GeometryWarning, stacklevel=2)
        checks = tuple(CheckRow.of(check, stage=record.folder.name) for check in record.manifest["checks"])
        return Section(title=title, text=(message,), checks=checks)


def readable_numbers(record: StageRecord, make: Callable[[], tuple[KeyNumber, ...]]) -> tuple[KeyNumber, ...]:
    """Make the key numbers of a stage from its manifest; none, with a warning, where it cannot be read."""
    try:
        with values_of(record):
            return make()
    except InputError as error:
        if record.ran:
            raise
        warnings.warn(f"report: {record.folder.name} cannot be read: {error}", GeometryWarning, stacklevel=2)
        return ()
