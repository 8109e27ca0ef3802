"""The page of a batch: `index.html` for any number of subjects, `index.json` that it polls, `summary.csv` beside it."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jinja2
from rich.console import Group
from rich.table import Table
from rich.text import Text

from pipelines.batch.plan import Cost
from pipelines.batch.records import read_batch
from pipelines.batch.table import BatchTable, Row, count_states, csv_text
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import jsonable

log = logging.getLogger(__name__)

INDEX_FILE, DATA_FILE, SUMMARY_FILE = "index.html", "index.json", "summary.csv"
STATE_STYLES = {
    "failed": "red",
    "refused": "red",
    "stopped": "yellow",
    "running": "blue",
    "waiting": "dim",
    "done": "green",
}


def write_index(runs: str | Path, *, table: BatchTable | None = None, every: float = 5.0) -> list[Row]:
    """Write `index.html`, `index.json` and `summary.csv` of a batch, each whole or not at all.

    Args:
        runs: folder of the batch.
        table: the table that wrote last, which knows the subjects that have not changed since.
        every: seconds after which an open page looks for a newer state while subjects run or wait.

    Returns:
        The rows, worst first.
    """
    runs = Path(runs)
    rows = (table or BatchTable(runs)).rows()
    content = page_content(runs, rows, every=every)
    numbered = [replace(row, convention=_numbered(row, content["conventions"])) for row in rows]
    atomic_write_text(runs / SUMMARY_FILE, csv_text(numbered))
    atomic_write_text(runs / DATA_FILE, json.dumps(content, separators=(",", ":"), allow_nan=False))
    atomic_write_text(runs / INDEX_FILE, page_html(content))
    return rows


class IndexWriter:
    """Keep the page of a batch up to date while it runs, at most as often as an open page looks.

    Args:
        runs: folder of the batch.
        every: seconds between two states. A thousand subjects take half a second.
    """

    def __init__(self, runs: Path, *, every: float = 10.0) -> None:
        self.every, self._table, self._next = every, BatchTable(runs), 0.0

    def update(self) -> None:
        """Write the page if it is time; a disk that is full, or away, is no reason to end a batch."""
        if time.monotonic() >= self._next:
            try:
                self.write()
            except OSError as error:
                log.warning("%s is not written: %s", self._table.runs / INDEX_FILE, error)
            self._next = time.monotonic() + self.every

    def write(self) -> list[Row]:
        """Write the page and return its rows, worst first."""
        return write_index(self._table.runs, table=self._table, every=self.every)


def page_content(runs: Path, rows: Sequence[Row], *, every: float = 5.0) -> dict[str, Any]:
    """Return what the page shows, as JSON values: rows as lists in the order of `fields`, conventions stated once.

    Args:
        runs: folder of the batch, whose `batch.json` names its version and start.
        rows: the rows, worst first.
        every: seconds between two looks of an open page.
    """
    conventions = list(dict.fromkeys(row.convention for row in rows if row.convention))
    batch, names = read_batch(runs), [field.name for field in fields(Row)]
    lists = []
    for row in rows:
        row = replace(row, convention=_numbered(row, conventions))
        values = [getattr(row, name) for name in names]
        # Four digits are what a reader sees, and a third of the bytes of a number.
        lists.append([float(f"{value:.4g}") if isinstance(value, float) else value for value in values])
    counts = count_states(rows)
    content = {
        "title": batch.name,
        "version": batch.version,
        "started": batch.started,
        "updated": datetime.now(UTC).isoformat(timespec="seconds"),
        "every": every,
        "live": bool(counts["running"] or counts["waiting"]),
        "counts": counts,
        "fields": names,
        "rows": lists,
        "conventions": conventions,
        "metrics": list(dict.fromkeys(row.metric for row in rows if row.metric)),
    }
    return dict(jsonable(content))


def _numbered(row: Row, conventions: Sequence[str]) -> str:
    """Return the number of a row's convention, from 1; empty where the row has no figures."""
    return str(conventions.index(row.convention) + 1) if row.convention else ""


def page_html(content: dict[str, Any]) -> str:
    """Return the page as one HTML text, without network, fonts or other files."""
    # The style is that of a run's report; the page adds what a long table needs.
    folders = [jinja2.PackageLoader(f"pipelines.{room}", "") for room in ("batch", "report")]
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.ChoiceLoader(folders),
    )
    # Text of users must not end the script element that carries it.
    data = json.dumps(content, separators=(",", ":"), allow_nan=False)
    for sign in "<>&":
        data = data.replace(sign, f"\\u{ord(sign):04x}")
    return environment.get_template("index.html.j2").render(title=content["title"], data=data, files=SUMMARY_FILE)


def terminal_table(rows: Sequence[Row], *, most: int = 40) -> Group:
    """Return the first rows as a table for a terminal; reasons stand below it, as wide as the terminal.

    Args:
        rows: the rows, worst first.
        most: rows that are shown; the caption counts the others.
    """
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("subject", overflow="fold")
    for name in ("state", "step"):
        table.add_column(name, no_wrap=True)
    for name in ("min", "GPU h", "gates", "poses dB", "views dB", "P2S mm", "MB"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows[:most]:
        p2s = row.poses_p2s if row.poses_p2s is not None else row.views_p2s
        table.add_row(
            Text(row.subject),
            Text(row.state, style=STATE_STYLES[row.state]),
            f"{row.step} {row.done}/{row.steps}".strip(),
            f"{row.minutes:.1f}",
            _cell(row.gpu_hours or None, 2),
            _cell(row.gates_failed, 0),
            _cell(row.poses_psnr, 2),
            _cell(row.views_psnr, 2),
            _cell(p2s, 2),
            _cell(row.megabytes, 1),
        )
    if len(rows) > most:
        table.caption = f"{len(rows) - most} more in {INDEX_FILE} and {SUMMARY_FILE}"
    # Untrusted words are text, never markup.
    return Group(table, *(Text(f"{row.subject}: {row.reason}", style="dim") for row in rows[:most] if row.reason))


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def cost_table(costs: Mapping[str, Cost], head: str) -> Table:
    """Return hours, gigabytes and files by step, and their sums, as a terminal shows them."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column(head)
    for name in ("core hours", "GPU hours", "GB read", "GB kept", "files"):
        table.add_column(name, justify="right")
    for step, cost in [*costs.items(), ("sum", sum(costs.values(), Cost()))]:
        hours, *numbers = (f"{n:,.3f}" for n in (cost.core_hours, cost.gpu_hours, cost.read_gb, cost.written_gb))
        hours += f" ± {cost.unsure_hours:,.3f}" if cost.unsure_hours else ""
        table.add_row(step, hours, *numbers, f"{cost.files:,.0f}")
    return table
