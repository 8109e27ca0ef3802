"""One table as text, CSV and LaTeX, and the tables of an evaluation."""

from __future__ import annotations

import csv
import io

import pytest

from avatar.evaluation.tables import Column, FigureTable, escape_latex
from smplxpp.core.errors import InputError

COLUMNS = (
    Column("psnr", "PSNR", "novel views", 2, "higher"),
    Column("lpips", "ST-LPIPS", "novel views", 4, "lower"),
    Column("count", "parameters", "", 0),
    Column("never", "never measured"),
)
ROWS = {
    "Full": {"psnr": 26.123456, "lpips": 0.0301, "count": 1234567.0},
    "w/o Mesh Non.": {"psnr": 24.0, "lpips": None, "count": 1000.0},
    "100 %_odd": {"psnr": float("inf"), "lpips": 0.2},
}


def table(**changes) -> FigureTable:
    return FigureTable(**{"columns": COLUMNS, "rows": ROWS, "caption": "On a doll", **changes})


def test_text_aligns_figures_and_leaves_out_empty_columns():
    lines = table().text().splitlines()
    assert lines[0] == "On a doll" and "never" not in lines[2]
    assert lines[1].rstrip().endswith("novel views")
    assert lines[3].split() == ["Full", "26.12", "0.0301", "1,234,567"]
    assert lines[4].split()[-3:] == ["24.00", "-", "1,000"] and lines[5].split()[-3:] == ["inf", "0.2000", "-"]
    ends = {
        line.index(word) + len(word) for line, word in zip(lines[2:6], ("PSNR", "26.12", "24.00", "inf"), strict=True)
    }
    assert len(ends) == 1


def test_a_wide_table_goes_on_below_with_every_figure_once_and_the_rows_named_again():
    whole = table(caption="words that " * 12)
    text = whole.text(width=40)
    assert max(map(len, text.splitlines())) <= 40
    assert text.split().count("Full") == 2 and "\n\n" in text
    cells = [cell for row in whole.cells() for cell in row[1:] if cell != "-"]
    assert all(text.split().count(cell) == cells.count(cell) for cell in cells)
    assert whole.text(width=400) == whole.text().replace(whole.caption, whole.caption.strip())
    # A column that alone is wider stays whole.
    assert "parameters" in whole.text(width=5)


def test_csv_keeps_every_digit():
    rows = list(csv.reader(io.StringIO(table().csv())))
    assert rows[0] == ["model", "psnr", "lpips", "count"]
    assert float(rows[1][1]) == ROWS["Full"]["psnr"] and rows[2][2] == "" and rows[3][3] == ""


def test_latex_is_booktabs_with_the_best_in_bold():
    text = table(rows={k: ROWS[k] for k in ("Full", "w/o Mesh Non.")}).latex(label="tab:x")
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"\label{tab:x}", r"\multicolumn{2}{c}{novel views}"):
        assert part in text
    assert r"\cmidrule(lr){2-3}" in text and r"PSNR $\uparrow$" in text and r"ST-LPIPS $\downarrow$" in text
    assert r"\textbf{26.12}" in text and r"\textbf{24.00}" not in text and "& -- &" in text
    assert text.count(r"\textbf") == 1  # one figure alone has no rival, and a count no winner
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert {line.count("&") for line in body[1:]} == {3}


def test_what_latex_reads_as_commands_is_escaped():
    assert escape_latex("100 %_a{b}") == r"100 \%\_a\{b\}"
    assert r"100 \%\_odd" in table().latex()


def test_rows_that_show_the_same_share_the_win():
    rows = {"a": {"psnr": 20.001}, "b": {"psnr": 20.004}, "c": {"psnr": 19.0}}
    assert table(rows=rows).best(COLUMNS[0]) == {"a", "b"}
    assert table(rows={k: {"psnr": 1.0} for k in "ab"}).best(COLUMNS[0]) == set()


def test_columns_need_keys_of_their_own():
    with pytest.raises(InputError, match="distinct"):
        FigureTable((COLUMNS[0], COLUMNS[0]), ROWS)
