"""Pages of benchmarks: tables are what stored results give, every result is linked, and conditions are named."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from benchmarks.__main__ import FOLDERS, commands
from benchmarks.support.page import BENCHMARKS, DIRECTIVE, PAGES, main, named, page, shown, table_of
from benchmarks.support.results import RESULTS, ROOT, rows_json, store_results

TEXT = "\n".join(path.read_text() for path in BENCHMARKS)


def sections() -> list[str]:
    """Return the pages' text below each heading."""
    return [one for path in BENCHMARKS for one in path.read_text().split("\n## ")[1:]]


def figures(name: str) -> dict:
    """Return what a stored result measured."""
    return json.loads((RESULTS / f"{name}.json").read_text())["figures"]


def test_the_pages_are_what_the_stored_results_give():
    assert {"benchmarks.md", "exports.md", "real.md"} < {path.name for path in PAGES}
    assert set(BENCHMARKS) <= set(PAGES)
    assert main(["--check"]) == 0, "run `python -m benchmarks.support.page`"


def test_a_changed_figure_is_found():
    text = BENCHMARKS[0].read_text()
    assert "| 35.1 | 27.2 |" in text
    assert page(text.replace("| 35.1 | 27.2 |", "| 35.8 | 27.0 |")) == text


def test_pages_are_short():
    """The reference is made of docstrings and is no file here."""
    for path in (ROOT / "docs").glob("*.md"):
        assert len(path.read_text().splitlines()) <= 300, path.name


@pytest.mark.parametrize("folder", ["", "closed"])
def test_every_stored_result_is_linked(folder):
    text = "".join(one.read_text() for one in sorted((ROOT / "docs").glob("*.md")))
    for path in (RESULTS / folder).glob("*.json"):
        assert f"](../{path.relative_to(ROOT)})" in text, path.name


def test_tables_stand_beside_a_link_to_their_data():
    for section in sections():
        for directive in filter(None, map(DIRECTIVE.match, section.splitlines())):
            for name in named(directive.group(1)):
                assert f"results/{name}.json" in section, name


def test_sections_with_images_name_protocol_convention_and_count():
    for section in sections():
        if re.search(r"psnr", section) and "<!-- table" in section and not section.startswith("Kernels"):
            assert re.search(r"`exact`|`tracked`", section), section[:60]
            assert re.search(r"person|image", section), section[:60]


def test_psnr_is_given_in_both_conventions_where_both_are_stored():
    for text in (
        "| 35.1 | 27.2 | 26.7 | 19.2 |",
        "of the image*, the paper's convention",
        "*of the person*",
        "ST-LPIPS",
    ):
        assert text in TEXT
    student = figures("training_woman_casual_cpu_tracked")["evaluation"]["student"]["views"]
    assert [
        round(student[part][key], 1) for part in ("novel_view", "novel_pose") for key in ("psnr_image", "psnr")
    ] == [
        35.1,
        27.2,
        26.7,
        19.2,
    ]


def test_unfavourable_rows_come_first():
    first, *_ = sections()
    assert first.startswith("Where the method loses")
    for stored in ("ablation_woman_casual_every_frame_tracked", "ablation_woman_casual_every_frame"):
        full, trained = (figures(stored)["rows"][row]["surface.training.skin.p2s"] for row in ("Full", "LBS Gaussians"))
        assert full > trained and f"| {full:.2f} |" in first and f"| {trained:.2f} |" in first


@pytest.mark.parametrize("stored", ["ablation_woman_casual_every_frame", "ablation_person_demo_tracked"])
def test_every_row_of_the_ablation_is_shown(stored):
    (section,) = (one for one in sections() if one.startswith("Rows of the ablation"))
    for name, row in figures(stored)["rows"].items():
        (line,) = (line for line in section.splitlines() if line.startswith(f"| {name} |"))
        assert f"| {row['novel_view.psnr']:.2f} |" in line


def test_no_damaged_file_did_harm():
    doors = figures("damaged_files")
    harm = ("foreign exception", "crash", "hang", "over memory")
    assert not any(door[kind] for door in doors.values() for kind in harm)
    assert f"All {len(doors)} doors" in TEXT


def test_a_directive_makes_a_table(tmp_path):
    content = {"rows": {"a": {"x": 1.0, "deep": {"y": 2}}, "b": {"x": 3.25}, "c": {}}, "list": [{"name": "q", "x": 7}]}
    other = {"a": {"z": 5}, "d": {"z": 6}}
    (tmp_path / "one.json").write_text(json.dumps({"figures": content}))
    (tmp_path / "two.json").write_text(json.dumps({"figures": other}))

    def made(words: str) -> list[str]:
        return table_of(words, tmp_path)[2:]

    assert made("from one / rows | show x as X .2f ; deep / y") == [
        "| a | 1.00 | 2 |",
        "| b | 3.25 | - |",
        "| c | - | - |",
    ]
    assert made("from one / rows | show x | sort -x | first 2") == ["| b | 3.25 |", "| a | 1 |"]
    assert made("from one / rows only b ; a as the | show x") == ["| the b | 3.25 |", "| the a | 1 |"]
    assert made("row one / rows / b as B | show *") == ["| B | 3.25 |"]
    assert made("from one / rows only a | with two as o | show o / z") == ["| a | 5 |"]
    assert made("from one / list | show x | turned") == ["| x | 7 |"]
    for wrong in ("from one / rows only none | show x", "from one / rows | shows x"):
        with pytest.raises((KeyError, ValueError)):
            made(wrong)


def test_values_are_shown_for_readers():
    values = [None, True, 12345, 1.23456, 123456.7, [1, 2.5], "a|b"]
    assert list(map(shown, values)) == ["-", "yes", "12,345", "1.235", "123,457", "1, 2.5", "a\\|b"]


@pytest.mark.parametrize("path", sorted(RESULTS.rglob("*.json")), ids=lambda path: path.stem)
def test_stored_results_have_a_row_a_line(path):
    text = path.read_text()
    assert text == rows_json(json.loads(text)) + "\n", "run `python -m benchmarks.support.results`"


def test_written_results_read_back_equal(tmp_path):
    rows = [{"name": "x" * 200, "deep": {"values": list(range(9))}, "empty": [], "none": None} for _ in range(8)]
    path = store_results("one", "command", {"rows": rows, "size": (1, 2)}, folder=tmp_path)
    assert json.loads(path.read_text())["figures"] == {"rows": rows, "size": [1, 2]}
    assert sum(line.startswith('   {"name"') for line in path.read_text().splitlines()) == 8


def test_the_docs_name_commands_that_exist():
    listed = {name for names in commands().values() for name in names}
    assert set(commands()) == set(FOLDERS) and len(listed) > 30
    for path in [*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]:
        text = path.read_text()
        if path.name != "research.md":
            assert set(re.findall(r"python -m\s+benchmarks ([a-z_]+)", text)) <= listed, path.name


def test_every_benchmark_is_listed_or_imported():
    listed = {name for names in commands().values() for name in names}
    code = "".join(path.read_text() for path in Path(ROOT / "benchmarks").rglob("*.py"))
    for folder in FOLDERS:
        for path in (ROOT / "benchmarks" / folder).glob("*.py"):
            name = path.stem.strip("_")
            assert name in {"init", "main"} | listed or f"benchmarks.{folder}.{name}" in code, path.name
