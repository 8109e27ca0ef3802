"""Fill the tables of the pages in docs/ from the stored results.

    python -m benchmarks.support.page [--check]

The pages are written by hand, except their tables. A comment before each table says what it shows:

    <!-- table | from NAME / KEY only A ; B | show KEY / KEY as TITLE .2f ; KEY | sort -TITLE -->

`from` makes a row of every mapping below a place in `benchmarks/results/NAME.json` (its figures), or of those listed;
with `as PREFIX` their names begin with it. `row` makes one row of the place itself. Several of both stand below each
other. `with NAME / KEY as WORD` adds to each row, below the key WORD, the row of the same name from another place.
`show` lists columns, with a heading and a number format; `show *` takes all values. `sort` orders rows by a column,
with `-` from large to small, those without a value last; `first 8` keeps eight. `turned` exchanges rows and columns.
`--check` only compares.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.support.results import RESULTS, ROOT
from smplxpp.core.files.atomic import atomic_write_text

BENCHMARKS = tuple(sorted((ROOT / "docs").glob("benchmarks*.md")))
DIRECTIVE = re.compile(r"^<!-- table \| (.*) -->$")
PAGES = tuple(path for path in sorted((ROOT / "docs").glob("*.md")) if "<!-- table | " in path.read_text("utf-8"))


def page(text: str, results: Path = RESULTS) -> str:
    """Return the page with every table made again from the stored results."""
    lines, kept = text.splitlines(), []
    in_table = False
    for line in lines:
        directive = DIRECTIVE.match(line)
        in_table = in_table and line.startswith("|")
        if not in_table:
            kept.append(line)
        if directive:
            kept += table_of(directive.group(1), results)
            in_table = True
    return "\n".join(kept) + "\n"


def table_of(directive: str, results: Path = RESULTS) -> list[str]:
    """Return the lines of the Markdown table that a directive describes."""
    rows: list[tuple[str, Mapping[str, Any]]] = []
    columns: list[tuple[list[str], str, str]] = []
    order, turned, count = "", False, None
    for clause in directive.split(" | "):
        verb, _, rest = clause.partition(" ")
        if verb in ("from", "row"):
            rows += _rows(rest, verb == "row", results)
        elif verb == "show":
            columns = [_column(one) for one in rest.split(" ; ")] if rest != "*" else _all_columns(rows)
        elif verb == "with":
            place, _, word = rest.partition(" as ")
            beside = dict(_rows(place, False, results))
            rows = [(name, {**row, word: beside.get(name, {})}) for name, row in rows]
        elif verb == "first":
            count = int(rest)
        elif verb == "sort":
            order = rest
        elif verb == "turned":
            turned = True
        else:
            raise ValueError(f"{clause!r} is no clause of a table")
    if order:
        (keys,) = (keys for keys, title, _ in columns if title == order.removeprefix("-"))
        there = [row for row in rows if _at(row[1], keys) is not None]
        there.sort(key=lambda row: _at(row[1], keys), reverse=order.startswith("-"))
        rows = there + [row for row in rows if _at(row[1], keys) is None]
    cells = [[name, *(shown(_at(row, keys), form) for keys, _, form in columns)] for name, row in rows[:count]]
    cells.insert(0, ["", *(title for _, title, _ in columns)])
    return table([list(column) for column in zip(*cells, strict=True)] if turned else cells)


def table(cells: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table whose first row is the heading."""
    head, *body = (f"| {' | '.join(row)} |" for row in cells)
    return [head, "|---" * len(cells[0]) + "|", *body]


def shown(value: Any, form: str = "") -> str:
    """Return a stored value for readers: four significant digits without a format, "-" where there is none."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(shown(one, form) for one in value)
    if isinstance(value, int | float) and form:
        return format(value, form)
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}" if abs(value) >= 1e4 else str(value)
    return str(value).replace("|", "\\|")


def named(directive: str) -> set[str]:
    """Return the stored results that a directive takes rows from."""
    return set(re.findall(r"(?:^|\| )(?:from|row|with) ([^ ]+)", directive))


@cache
def _figures(path: Path) -> Any:
    return json.loads(path.read_text())["figures"]


def _rows(source: str, single: bool, results: Path) -> list[tuple[str, Mapping[str, Any]]]:
    """Return names and values of the rows of one source."""
    source, _, title = source.partition(" as ")
    source, _, chosen = source.partition(" only ")
    name, *keys = source.split(" / ")
    value = _at(_figures(results / f"{name}.json"), keys)
    if single:
        return [(title, value)]
    if isinstance(value, list):
        # Name rows of a list by their first text, or by their number.
        texts = [next((one for one in row.values() if isinstance(one, str)), str(k + 1)) for k, row in enumerate(value)]
        pairs = list(zip(texts, value, strict=True))
    else:
        pairs = [(key, row) for key, row in value.items() if isinstance(row, Mapping)]
    wanted = chosen.split(" ; ") if chosen else None
    if wanted is not None:
        missing = set(wanted) - {key for key, _ in pairs}
        if missing:
            raise KeyError(f"{name}.json has no rows {sorted(missing)}")
        pairs = [pair for want in wanted for pair in pairs if pair[0] == want]
    return [(f"{title} {key}".strip(), row) for key, row in pairs]


def _column(words: str) -> tuple[list[str], str, str]:
    """Return keys, heading and number format of a column."""
    key, _, title = words.partition(" as ")
    form = re.search(r" ((?:\.\d|,)[\w%]*)$", title or key)
    if form:
        title, key = title[: form.start()] if title else title, key if title else key[: form.start()]
    return key.split(" / "), title or key.split(" / ")[-1], form.group(1) if form else ""


def _all_columns(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> list[tuple[list[str], str, str]]:
    """Return a column for each value of any row."""
    keys = dict.fromkeys(key for _, row in rows for key, value in row.items() if not isinstance(value, Mapping))
    return [([key], key, "") for key in keys]


def _at(value: Any, keys: Sequence[str]) -> Any:
    """Return what lies below keys, None where there is nothing."""
    for key in keys:
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return value


def main(arguments: list[str] | None = None) -> int:
    """Write the pages, or with `--check` return 1 where one differs from the stored results."""
    check = "--check" in (sys.argv[1:] if arguments is None else arguments)
    differs = False
    for path in PAGES:
        text = path.read_text()
        made = page(text)
        differs |= made != text
        if not check:
            atomic_write_text(path, made)
    return int(check and differs)


if __name__ == "__main__":
    sys.exit(main())
