"""Lay out a `Report` as one self-contained HTML file, without network, fonts or other files."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from jaxtyping import Num
from markupsafe import Markup

from pipelines.report.model import (
    STATUSES,
    CheckRow,
    Curve,
    Histogram,
    KeyNumber,
    Picture,
    Report,
    Section,
    count_statuses,
    format_value,
    worst_status,
)
from pipelines.report.pictures import PAGE_BYTES, Embedded, embed_pictures
from pipelines.report.words import glossary_of, verdict_of
from pipelines.runs.artefacts import values_of
from pipelines.runs.stage import StageRecord
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.files.atomic import atomic_write_text

_WIDTH, _HEIGHT = 560, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 14, 44, 40


def histogram_statistics(values: Num[np.ndarray, "*shape"]) -> dict[str, float]:
    """Count and, of the finite values, mean, percentiles, min and max; count of the others."""
    values = np.asarray(values, dtype=np.float64).ravel()
    finite = values[np.isfinite(values)]
    if not len(finite):
        raise InputError(
            "values of a histogram", expected="at least one finite value", received=f"{len(values)} values"
        )
    # Percentiles of the finite values; the others are counted apart, because one NaN would hide all of them.
    p5, p50, p95, p99 = np.percentile(finite, [5, 50, 95, 99])
    return {
        "count": len(finite),
        "not_finite": len(values) - len(finite),
        "mean": float(finite.mean()),
        "p5": float(p5),
        "p50": float(p50),
        "p95": float(p95),
        "p99": float(p99),
        "min": float(finite.min()),
        "max": float(finite.max()),
    }


def histogram_svg(histogram: Histogram) -> str:
    """Bars of a histogram with its percentiles and gates, as an SVG element."""
    stats = histogram_statistics(histogram.values)
    values = np.asarray(histogram.values, dtype=np.float64).ravel()
    values = values[np.isfinite(values)]
    low, high = _range(histogram, values)
    bins = 64
    counts, edges = np.histogram(np.clip(values, low, high), bins=bins, range=(low, high))
    share = 100.0 * counts / len(values)
    top = max(float(share.max()), 1e-9)
    plot_width, plot_height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    base = _TOP + plot_height

    def x(value: float) -> float:
        return _LEFT + plot_width * (value - low) / (high - low)

    unit = f" {histogram.unit}" if histogram.unit else ""
    out = [
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(histogram.title)}: mean {format_value(stats["mean"])}{escape(unit)}, '
        f'95th percentile {format_value(stats["p95"])}{escape(unit)}">'
    ]
    for tick in _ticks(0.0, top, 4):
        y = base - plot_height * tick / top
        out.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        out.append(f'<text class="tick" x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:g} %</text>')
    cut_off = values > high
    for k in np.flatnonzero(counts):
        height = plot_height * share[k] / top
        last = k == bins - 1 and cut_off.any()
        label = f"{format_value(float(edges[k]))} to {'more' if last else format_value(float(edges[k + 1]))}{unit}"
        out.append(
            f'<rect class="{"bar beyond" if last else "bar"}" x="{x(edges[k]) + 0.5:.1f}" y="{base - height:.2f}" '
            f'width="{plot_width / bins - 1:.2f}" height="{height:.2f}">'
            f"<title>{escape(label)}: {share[k]:.3g} %</title></rect>"
        )
    out.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{base}" y2="{base}"/>')
    for tick in _ticks(low, high, 6):
        out.append(f'<text class="tick" x="{x(tick):.1f}" y="{base + 17}" text-anchor="middle">{tick:g}</text>')
    out.append(
        f'<text class="tick" x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 6}" text-anchor="end">{escape(histogram.unit)}'
        + (f" · {100 * cut_off.mean():.2g} % exceed the axis" if cut_off.any() else "")
        + "</text>"
    )
    marks = ("p5", "p50", "p95") if low < 0 else ("p50", "p95", "p99")
    lines = [("mark", "median" if key == "p50" else key, stats[key]) for key in marks]
    lines += [("gate", label, value) for label, value in histogram.gates]
    ends = {0: -1e9, 1: -1e9}  # where the last label of each of the two label rows ends
    for kind, label, value in sorted(lines, key=lambda line: line[2]):
        if not low <= value <= high:
            continue
        at = x(value)
        line_of_text = 0 if kind == "gate" else 1
        width = 6.8 * len(label)
        center = max(at, ends[line_of_text] + width / 2 + 5)
        ends[line_of_text] = center + width / 2
        y = 14 + 16 * line_of_text
        out.append(f'<line class="{kind}" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP - 8}" y2="{base}"/>')
        out.append(f'<text class="{kind}-text" x="{center:.1f}" y="{y}" text-anchor="middle">{escape(label)}</text>')
    return "".join([*out, "</svg>"])


def curve_svg(curve: Curve) -> str:
    """Lines with a dot at every point and the last value beside its end, as an SVG element."""
    lines = {}
    for name, (x, y) in curve.lines.items():
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        known = np.isfinite(x) & np.isfinite(y)
        if known.any():
            lines[name] = x[known], y[known]
    if not lines:
        raise InputError(f"curve {curve.title!r}", expected="at least one finite point", received="none")
    xs, ys = (np.concatenate([line[k] for line in lines.values()]) for k in (0, 1))
    low, high = float(xs.min()), float(xs.max())
    bottom, top = float(ys.min()), float(ys.max())
    high, pad = (high if high > low else low + 1.0), 0.08 * (top - bottom) or 0.5
    bottom, top = bottom - pad, top + pad
    right, base = _RIGHT + 44, _HEIGHT - _BOTTOM  # room for the values at the ends

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            _LEFT + (_WIDTH - _LEFT - right) * (x - low) / (high - low),
            base - (base - _TOP) * (y - bottom) / (top - bottom),
        )

    ends = ", ".join(f"{name} {format_value(float(y[-1]))}" for name, (_, y) in lines.items())
    unit = f" {curve.unit}" if curve.unit else ""
    out = [
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(curve.title)}, at the end: {escape(ends + unit)}">'
    ]
    for tick in _ticks(bottom, top, 4):
        level = place(low, tick)[1]
        out.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - right}" y1="{level:.1f}" y2="{level:.1f}"/>')
        out.append(f'<text class="tick" x="{_LEFT - 6}" y="{level + 4:.1f}" text-anchor="end">{tick:g}</text>')
    out.append(f'<line class="axis" x1="{_LEFT}" x2="{_WIDTH - right}" y1="{base}" y2="{base}"/>')
    for tick in _ticks(low, high, 6):
        at = place(tick, bottom)[0]
        out.append(f'<text class="tick" x="{at:.1f}" y="{base + 17}" text-anchor="middle">{tick:g}</text>')
    label = f"{curve.unit} over {curve.x_label}" if curve.unit else curve.x_label
    out.append(f'<text class="tick" x="{_WIDTH - right}" y="{_HEIGHT - 6}" text-anchor="end">{escape(label)}</text>')
    for k, (name, (x, y)) in enumerate(lines.items()):
        points = [place(float(a), float(b)) for a, b in zip(x, y, strict=True)]
        color = f"line{k % 3}"
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        out.append(f'<polyline class="line {color}" points="{path}"/>')
        for (a, b), value, where in zip(points, y, x, strict=True):
            title = f"{name}: {format_value(float(value))}{unit} at {format_value(float(where))} {curve.x_label}"
            out.append(
                f'<circle class="{color}" cx="{a:.1f}" cy="{b:.1f}" r="2.4"><title>{escape(title)}</title></circle>'
            )
        a, b = points[-1]
        out.append(f'<text class="value {color}" x="{a + 6:.1f}" y="{b + 4:.1f}">{format_value(float(y[-1]))}</text>')
        at = _LEFT + 150 * k
        out.append(f'<rect class="{color}" x="{at}" y="10" width="14" height="4" rx="2"/>')
        out.append(f'<text class="name" x="{at + 20}" y="17">{escape(name)}</text>')
    return "".join([*out, "</svg>"])


def timings_svg(seconds: Mapping[str, float]) -> str:
    """Horizontal bars of the seconds a stage took, as an SVG element; empty for no stages."""
    if not seconds:
        return ""
    row_height, left, right = 26, 150, 66
    longest = max(max(seconds.values()), 1e-9)
    height = row_height * len(seconds) + 4
    out = [f'<svg class="chart timings" viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="Seconds by stage">']
    for k, (name, value) in enumerate(seconds.items()):
        y = k * row_height
        width = max((_WIDTH - left - right) * value / longest, 1.0)
        out.append(f'<text class="name" x="{left - 8}" y="{y + 18}" text-anchor="end">{escape(name)}</text>')
        out.append(f'<rect class="bar" x="{left}" y="{y + 5}" width="{width:.1f}" height="{row_height - 9}" rx="2"/>')
        out.append(f'<text class="tick" x="{left + width + 6:.1f}" y="{y + 18}">{value:.2f} s</text>')
    return "".join([*out, "</svg>"])


def _range(histogram: Histogram, values: Num[np.ndarray, " N"]) -> tuple[float, float]:
    """The axis: from 0 for values without a sign, symmetric otherwise; never empty."""
    signed = values.min() < 0
    reach = histogram.upper
    if reach is None:
        # A gate far outside of the data is left out of the axis, because it would squeeze the bars to nothing.
        reach = float(np.percentile(np.abs(values), 99.5))
        reach = max([reach, *(1.05 * abs(gate) for _, gate in histogram.gates if abs(gate) <= 3.0 * reach)])
    reach = reach if reach > 0 else 1.0
    return (-reach, reach) if signed else (0.0, reach)


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers in [low, high], about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(s * power for s in (1, 2, 2.5, 5, 10) if s * power >= raw * 0.999)
    return [round(float(t), 12) for t in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step]


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
    environment.filters |= {
        "value": format_value,
        "flat": _flatten,
        "worst": worst_status,
        "embedded": _embedded(report).__getitem__,
    }
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
        verdict=verdict_of(report.kind, report.checks, report.uses),
        glossary=glossary_of(report),
        # List the checks that failed or warned first; STATUSES is ordered from the worst on.
        attention=sorted(
            (check for check in report.checks if check.status != "pass"), key=lambda c: STATUSES.index(c.status)
        ),
        by_stage=_by_stage(report.checks),
        total_seconds=sum(report.seconds.values()),
    )
    atomic_write_text(path, html)
    return Path(path)


def _embedded(report: Report) -> dict[Picture, Embedded]:
    """Encode all pictures of a report for the room that films leave."""
    words_bytes = 450_000  # room for words, tables and charts in a page: twice what the embedded person's page has
    pictures = list(report.hero)
    for section in report.sections:
        pictures += [*section.pictures, *(one for pair in section.comparisons for one in (pair.before, pair.after))]
    films = sum(len(film.uri) for section in report.sections for film in section.films)
    return embed_pictures(pictures, room=PAGE_BYTES - words_bytes - films)


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
