"""docs/benchmarks.md: what the stored results give, with every row of them, whatever a result looks like."""

from __future__ import annotations

import json

import pytest

from benchmarks.machine import RESULTS
from benchmarks.page import PAGE, main, page
from benchmarks.page_parts import PARTS, part_of
from benchmarks.page_tables import shown, tables_of


def test_the_stored_page_is_what_the_stored_results_give():
    assert PAGE.read_text() == page(), "run `python -m benchmarks.page`"
    assert main(["--check"]) == 0


def test_every_stored_result_is_described():
    stored = {path.stem for path in RESULTS.glob("*.json")}
    assert {part.name for part in PARTS} <= stored
    assert all(part_of(name).conditions != "Not described." for name in stored)
    assert all(len(part.conditions) > 20 for part in PARTS)


@pytest.mark.parametrize("stored", ["ablation_woman_casual_every_frame", "ablation_person_demo_tracked"])
def test_every_row_of_an_ablation_is_printed(stored):
    rows = json.loads((RESULTS / f"{stored}.json").read_text())["figures"]["rows"]
    (title,) = (part.title for part in PARTS if part.name == stored)
    text = page().split(f"## {title}\n")[1].split("\n## ")[0]
    for name, row in rows.items():
        (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} | {row['what']}")]
        assert (
            f"| {shown(row['novel_view.psnr'])} |" in line and f"| {shown(row['surface.training.skin.p2s'])} |" in line
        )
    assert "(**worse**)" in text and text.count("P2S skin") >= 2


def test_where_full_is_worse_than_trained_skinning_is_said():
    text = page()
    assert "P2S skin 2.45 against 2.18 (**worse**)" in text and "head, PSNR 26.0 against 26.4 (**worse**)" in text
    assert "P2S skin 1.72 against 1.41 (**worse**)" in text and "novel poses, PSNR 21.0 against 19.2 (better)" in text


def test_the_page_says_what_its_figures_rest_on():
    text = page()
    for words in ("All inputs are exact", "tracked surface", "L_non", "L_sem", "48 images", "ST-LPIPS"):
        assert words in text


def test_a_result_that_nobody_described_is_printed_too(tmp_path):
    content = {
        "command": "python -m benchmarks.new",
        "date": "2026-01-01",
        "machine": {"cpu": "some", "cores": 2, "memory_gib": 4.0},
        "figures": {"deep": {"a": {"b": {"c": {"d": 1.23456}}}}, "rows": [{"name": "first", "value": None}]},
    }
    (tmp_path / "new.json").write_text(json.dumps(content))
    text = page(tmp_path)
    assert "## new" in text and "Not described" in text and "1.235" in text and "| first |" in text


def test_nested_values_become_tables():
    wide = {"x": {str(k): k for k in range(20)}}
    assert "| 19 | 19 |" in tables_of(wide)
    joined = tables_of({"ours": {"squat": {"mean": 1.0, "p95": 2.0}, "twist": {"mean": 3.0, "p95": 4.5}}})
    assert "In each cell: mean / p95." in joined and "| ours | 1 / 2 | 3 / 4.5 |" in joined
    assert [shown(value) for value in (None, True, 12345, 1.23456, 123456.7, [1, 2.5], "a|b")] == [
        "-",
        "yes",
        "12,345",
        "1.235",
        "123,457",
        "1, 2.5",
        "a\\|b",
    ]


def test_results_of_tracked_inputs_come_first_and_say_so(tmp_path):
    content = json.loads((RESULTS / "training_person_demo.json").read_text())
    (tmp_path / "training_person_demo.json").write_text(json.dumps(content))
    content["figures"]["inputs"] = {**content["figures"]["inputs"], "parameters": "tracked", "name": "tracked"}
    (tmp_path / "training_person_demo_tracked.json").write_text(json.dumps(content))
    headings = [line for line in page(tmp_path).splitlines() if line.startswith("## ")]
    assert headings == ["## Training of `make demo`: tracked inputs", "## Training of `make demo`"]
    assert "**Nothing here is exact**" in page(tmp_path)
