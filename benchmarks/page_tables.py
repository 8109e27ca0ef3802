"""Stored figures as Markdown tables, whatever their nesting: nothing that is stored is left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

WIDE = 14
"""Columns beyond which a table is turned on its side."""
JOINED = 4
"""Figures that are printed in one cell, with strokes between them."""


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Return the lines of a Markdown table, numbers in four digits."""
    lines = [_line(header), _line(["---"] * len(header))]
    return [*lines, *(_line([shown(cell) for cell in row]) for row in rows), ""]


def shown(value: Any) -> str:
    """Return a stored value for readers: text as it is, numbers in four significant digits, "-" where there is none."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) >= 1e4 else str(value)
    if isinstance(value, list | tuple):
        return ", ".join(map(shown, value))
    return str(value).replace("|", "\\|")


def tables_of(figures: Any, *, level: int = 3) -> list[str]:
    """Return everything of a nested value as tables under headings of a level.

    Values beside each other make one table of two columns; mappings beside each other make one table with a row each,
    and a third nesting is joined in the cells.
    """
    figures = _by_name(figures)
    if not isinstance(figures, Mapping):
        return [shown(figures), ""]
    single = {name: value for name, value in figures.items() if not isinstance(value, Mapping)}
    nested = {name: value for name, value in figures.items() if isinstance(value, Mapping)}
    lines = table(("", ""), list(single.items())) if single else []
    if not nested:
        return lines
    if all(_depth(value) == 1 for value in nested.values()):
        return [*lines, *_grid(nested)]
    if all(_joins(value) for value in nested.values()):
        parts = dict.fromkeys(key for row in nested.values() for cell in row.values() for key in cell)
        cells = {name: {column: _cell(cell) for column, cell in row.items()} for name, row in nested.items()}
        return [*lines, f"In each cell: {' / '.join(parts)}.", "", *_grid(cells)]
    for name, value in nested.items():
        lines += [f"{'#' * level} {name}", "", *tables_of(value, level=min(level + 1, 6))]
    return lines


def _grid(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a table with a row a name, on its side where it would be too wide."""
    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    if len(columns) > max(WIDE, len(rows)):
        return table(("", *rows), [(key, *(row.get(key) for row in rows.values())) for key in columns])
    return table(("", *columns), [(name, *(row.get(key) for key in columns)) for name, row in rows.items()])


def _by_name(value: Any) -> Any:
    """Return lists of mappings as mappings: by their first text, or by their place."""
    if isinstance(value, Mapping):
        return {str(name): _by_name(one) for name, one in value.items()}
    if isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value):
        names = [next((text for text in one.values() if isinstance(text, str)), None) for one in value]
        distinct = None not in names and len(set(names)) == len(names)
        titles = names if distinct else [str(k + 1) for k in range(len(value))]
        return {title: _by_name(one) for title, one in zip(titles, value, strict=True)}
    return value


def _depth(value: Any) -> int:
    if not isinstance(value, Mapping):
        return 0
    return 1 + max((_depth(one) for one in value.values()), default=0)


def _joins(row: Mapping[str, Any]) -> bool:
    """Whether every cell of a row is a few figures that fit beside each other."""
    return all(_depth(cell) == 1 and len(cell) <= JOINED for cell in row.values())


def _cell(cell: Mapping[str, Any]) -> str:
    return " / ".join(shown(value) for value in cell.values())


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def registration_lines(figures: Mapping[str, Any]) -> list[str]:
    """Return the errors of every kind of input, of training and of held-out frames."""
    columns = {"body_mm": "body", "bare_mm": "bare skin", "covered_mm": "under cloth", "joints_mm": "joints"}
    columns["degrees"] = "degrees a joint"
    heads = ["input", "frames", *columns.values(), *(f"held out: {title}" for title in columns.values()), "CPU s"]
    rows = []
    for name, row in figures["rows"].items():
        parts = [row.get(part, {}) for part in ("training", "held_out")]
        errors = [part.get(key) for part in parts for key in columns]
        rows.append((name, row.get("frames"), *errors, row.get("cpu_seconds")))
    memory = figures["peak_memory_gib"]
    return [
        f"Protocol `{figures['protocol']}`, {figures['cameras']} training cameras; mm and degrees, means over frames, "
        f"nothing aligned; at most {memory:.1f} GiB of memory for all.",
        "",
        *table(heads, rows),
    ]


def reconstruction_lines(figures: Mapping[str, Any]) -> list[str]:
    """Return hull and refined surface of every case, what was left out, and errors by confidence."""
    heads = ("case", "views", "P2S mean", "median", "p95", "completeness mean", "median", "within 5 mm")
    rows, costs, sure, lines = [], [], [], []
    for case, row in figures["rows"].items():
        for which in ("hull", "refined"):
            forth, back = row[which]["p2s"], row[which]["completeness"]
            numbers = [forth["mean"], forth["median"], forth["p95"], back["mean"], back["median"], back["within_5_mm"]]
            rows.append((f"{case}: {which}", row["views"], *numbers))
        seen = row["refined"]["seen_by_two"]
        rows.append(
            (f"{case}: refined, seen by two", row["views"], seen["mean"], seen["median"], seen["p95"]) + (None,) * 3
        )
        what = ("pixel_mm", "cell_mm", "vertices", "genus", "unseen", "silhouettes", "seconds", "cpu_seconds")
        costs.append((case, *(row[key] for key in what), row["peak_memory_gib"]))
        sure += [
            (case, *(one[key] for key in ("from", "share", "mean", "median", "p95")))
            for one in row["refined"]["by_confidence"]
        ]
        if row["left_out"]:
            lines += [
                f"Left out of {case}: " + "; ".join(f"{name} ({why})" for name, why in row["left_out"].items()) + ".",
                "",
            ]
    return [
        *table(heads, rows),
        *lines,
        *table(
            ("case", "pixel, mm", "cell, mm", "vertices", "genus", "unseen", "IoU with masks", "s", "CPU s", "GiB"),
            costs,
        ),
        *table(("case", "confidence from", "share of vertices", "error mean", "median", "p95"), sure),
    ]
