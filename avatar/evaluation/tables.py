"""Format a table of figures as text, CSV or LaTeX."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

from smplxpp.core.errors import InputError

_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
}


@dataclass(frozen=True)
class Column:
    """Column of a table: one figure of every row.

    Attributes:
        key: name of the figure in the rows.
        title: heading of the column, with its unit.
        group: heading over this and neighbouring columns.
        digits: after the point.
        better: direction of better values; "" where neither is better.
    """

    key: str
    title: str
    group: str = ""
    digits: int = 2
    better: Literal["higher", "lower", ""] = ""

    def shown(self, value: float | None) -> str:
        """Return the value for readers; "-" where there is none."""
        if value is None or math.isnan(value):
            return "-"
        return f"{value:,.{self.digits}f}" if math.isfinite(value) else ("inf" if value > 0 else "-inf")


@dataclass(frozen=True)
class FigureTable:
    """Rows of figures under titled columns; columns that no row has a figure for are left out.

    Attributes:
        columns: those with a figure in some row.
        rows: figures by name and key.
        caption: in words.
        row_title: heading over the names.

    Example:
        >>> table = FigureTable((Column("psnr", "PSNR, dB", better="higher"),), {"Full": {"psnr": 27.1}})
        >>> Path("table.tex").write_text(table.latex(label="tab:ablation"))
    """

    columns: tuple[Column, ...]
    rows: Mapping[str, Mapping[str, float | None]]
    caption: str = ""
    row_title: str = "model"

    def __post_init__(self) -> None:
        # Columns without any figure would only say "-" and are left out of the table.
        keys = [column.key for column in self.columns]
        if len(set(keys)) < len(keys):
            raise InputError("table columns", expected="distinct keys", received=", ".join(keys))
        known = tuple(c for c in self.columns if any(row.get(c.key) is not None for row in self.rows.values()))
        object.__setattr__(self, "columns", known)

    def header(self) -> list[str]:
        """Return the titles, each with its group, for a table without groups."""
        return [self.row_title, *(f"{c.group}: {c.title}" if c.group else c.title for c in self.columns)]

    def cells(self) -> list[list[str]]:
        """Return names and figures as shown, a list for each row."""
        return [[name, *(c.shown(row.get(c.key)) for c in self.columns)] for name, row in self.rows.items()]

    def best(self, column: Column) -> set[str]:
        """Return the names of the rows that show the best value of a column; none where all or no rows do."""
        # Compared as shown: rows whose difference is less than the printed digits are equally good.
        values = {name: row.get(column.key) for name, row in self.rows.items()}
        known = {name: value for name, value in values.items() if value is not None and not math.isnan(value)}
        if not column.better or len(known) < 2:
            return set()
        best = column.shown((max if column.better == "higher" else min)(known.values()))
        winners = {name for name, value in known.items() if column.shown(value) == best}
        return winners if len(winners) < len(known) else set()

    def text(self, *, width: int | None = None) -> str:
        """Return the table aligned by spaces, groups over their columns, the caption above.

        Args:
            width: of a line; a wider table continues below with further columns, each time with the rows' names, and a
                column or a word that alone is wider stays whole. None: one line a row.
        """
        caption = [self.caption] if self.caption else []
        if width is not None:
            caption = textwrap.wrap(self.caption, width, break_long_words=False, break_on_hyphens=False)
        blocks = "\n\n".join("\n".join(part._lines()) for part in self._parts(width))
        return "\n".join([*caption, blocks]) + "\n"

    def _parts(self, width: int | None) -> list[FigureTable]:
        """Return tables of neighbouring columns that are at most so wide; groups are cut where they alone are wider."""
        if width is None or self._fits(width):
            return [self]
        units = [list(members) for _, members in groupby(self.columns, lambda column: column.group)]
        parts: list[FigureTable] = []
        for unit in units:
            for columns in [unit] if replace(self, columns=tuple(unit))._fits(width) else [[one] for one in unit]:
                wider = replace(self, columns=(*parts[-1].columns, *columns)) if parts else None
                if wider is not None and wider._fits(width):
                    parts[-1] = wider
                else:
                    parts.append(replace(self, columns=tuple(columns)))
        return parts

    def _fits(self, width: int) -> bool:
        return max(map(len, self._lines())) <= width

    def _lines(self) -> list[str]:
        """Return the lines of headings and rows."""
        # A column is as wide as its widest cell, and the last column of a group takes what its title needs more.
        body = [[self.row_title, *(c.title for c in self.columns)], *self.cells()]
        widths = [max(map(len, column)) for column in zip(*body, strict=True)]
        groups = [(title, list(members)) for title, members in groupby(range(len(self.columns)), self._group)]
        for title, members in groups:
            missing = len(title) - sum(widths[k + 1] for k in members) - 2 * (len(members) - 1)
            widths[members[-1] + 1] += max(missing, 0)
        # Names to the left, numbers to the right, so that their decimal points are in line.
        aligned = [[row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in body]
        lines = ["  ".join(cells) for cells in aligned]
        if any(title for title, _ in groups):
            spans = [title.rjust(sum(widths[k + 1] for k in m) + 2 * (len(m) - 1)) for title, m in groups]
            lines.insert(0, "  ".join([" " * widths[0], *spans]))
        return [line.rstrip() for line in lines]

    def csv(self) -> str:
        """Return the table as CSV: keys as header, every digit of the figures, empty cells without a figure."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([self.row_title, *(c.key for c in self.columns)])
        for name, row in self.rows.items():
            values = [row.get(c.key) for c in self.columns]
            writer.writerow([name, *("" if value is None else repr(value) for value in values)])
        return out.getvalue()

    def latex(self, *, label: str = "") -> str:
        r"""Return a LaTeX `table` for the package booktabs; the best value of a column is bold.

        Args:
            label: of the table, for `\ref`.
        """
        # Arrows state which direction is better; \cmidrule underlines the columns of a group.
        arrows = {"higher": r" $\uparrow$", "lower": r" $\downarrow$", "": ""}
        groups = [(title, list(members)) for title, members in groupby(range(len(self.columns)), self._group)]
        lines = [r"\begin{table}", r"\centering"]
        if self.caption:
            lines.append(rf"\caption{{{escape_latex(self.caption)}}}")
        if label:
            lines.append(rf"\label{{{label}}}")
        lines += [rf"\begin{{tabular}}{{l{'r' * len(self.columns)}}}", r"\toprule"]
        if any(title for title, _ in groups):
            spans = [rf"\multicolumn{{{len(m)}}}{{c}}{{{escape_latex(title)}}}" for title, m in groups]
            rules = [rf"\cmidrule(lr){{{m[0] + 2}-{m[-1] + 2}}}" for title, m in groups if title]
            lines += [" & ".join(["", *spans]) + r" \\", "".join(rules)]
        titles = [escape_latex(self.row_title), *(escape_latex(c.title) + arrows[c.better] for c in self.columns)]
        lines += [" & ".join(titles) + r" \\", r"\midrule"]
        # Bold the best figure of each column, ties included.
        best = [self.best(column) for column in self.columns]
        for name, *figures in self.cells():
            cells = [
                rf"\textbf{{{f}}}" if name in b else ("--" if f == "-" else f)
                for f, b in zip(figures, best, strict=True)
            ]
            lines.append(" & ".join([escape_latex(name), *cells]) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"]) + "\n"

    def _group(self, k: int) -> str:
        return self.columns[k].group


def escape_latex(text: str) -> str:
    """Return text with the special characters of LaTeX escaped."""
    return "".join(_LATEX.get(char, char) for char in text)
