"""The table of a batch and its page: order, reasons, figures, links, and what changes while it runs."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import fields

import pytest
from rich.console import Console

from pipelines.batch.page import IndexWriter, page_content, terminal_table, write_index
from pipelines.batch.table import BatchTable, Row, csv_text, worst_first
from smplxpp.core import InputError
from tests.batch.made import write_batch, write_manifest, write_subject
from tests.web.chromium import Page, find_chromium
from tests.web.test_embed import AXE, FINDINGS, SIZES, SMALL


def test_rows_hold_what_records_and_manifests_say(tmp_path):
    runs = write_batch(tmp_path / "made", 20)
    figures = {
        "novel_pose.psnr": 17.25,
        "surface.held_out.p2s": 8.5,
        "megabytes": 20.0,
        "novel_view.psnr": float("nan"),
    }
    write_subject(runs, "subject_0007", "done", **figures)
    failed = [{"name": "PSNR", "status": "fail", "value": 17.25}, {"name": "P2S", "status": "warn", "value": 8.5}]
    write_manifest(runs / "subject_0007" / "run", "97_relight", checks=failed)
    (runs / "subject_0007" / "player.html").write_text("player")
    row = next(row for row in BatchTable(runs).rows() if row.subject == "subject_0007")
    assert (row.state, row.step, row.done, row.steps) == ("done", "", 6, 6)
    assert (row.minutes, row.cpu_minutes, row.gpu_hours) == (6.0, 9.0, pytest.approx(2 / 60))  # two GPUs for a minute
    assert (row.gates_failed, row.gates_warned, row.model, row.protocol) == (1, 1, "student", "tracked")
    assert (row.poses_psnr, row.poses_p2s, row.views_psnr, row.megabytes) == (17.25, 8.5, None, 20.0)
    assert (row.report, row.player) == ("subject_0007/run/report.html", "subject_0007/player.html")
    assert row.metric == "st-lpips" and "P2S" in row.convention


def test_the_worst_come_first_with_their_reasons(tmp_path):
    runs = write_batch(tmp_path / "made", 40)
    (runs / "subject_0008" / "job.json").write_text("{")  # a disk that was full
    rows = BatchTable(runs).rows()
    assert len(rows) == 41
    assert [row.state for row in rows[:5]] == ["failed"] * 3 + ["refused"] * 2
    broken = next(row for row in rows if row.subject == "subject_0008")
    assert "cannot be read" in broken.reason
    refused = next(row for row in rows if row.state == "refused")
    assert refused.reason == "scan: expected one whole person, received two heads <b>& a dog</b>. Give --params"
    # A disk that was full leaves its subject waiting, and says why.
    record = json.loads((runs / "subject_0004" / "job.json").read_text())
    record["steps"][0]["error"] = {"message": "no space left on device"}
    (runs / "subject_0004" / "job.json").write_text(json.dumps(record))
    waiting = [row for row in BatchTable(runs).rows() if row.state == "waiting"]
    assert {row.reason for row in waiting} == {"", "no space left on device"}
    done = [row for row in rows if row.state == "done"]
    assert [row.poses_psnr for row in done] == sorted(row.poses_psnr for row in done)
    # Failed gates go before bad pictures, and a harder protocol before an exact one.
    a, b, c = Row("a", "done", gates_failed=2, poses_psnr=30.0), Row("b", "done", protocol="exact"), Row("c", "done")
    assert [row.subject for row in worst_first([b, a, c])] == ["a", "b", "c"]
    assert next(row for row in rows if row.subject == "not_begun") == Row("not_begun", "waiting", steps=6)
    with pytest.raises(InputError, match="out"):
        BatchTable(tmp_path).rows()


def test_a_table_reads_again_only_what_changed(tmp_path, monkeypatch):
    runs, read = write_batch(tmp_path / "made", 20), []
    from pipelines.batch import table as module

    first = module.read_row
    monkeypatch.setattr(module, "read_row", lambda runs, name, **more: read.append(name) or first(runs, name, **more))
    table = BatchTable(runs)
    table.rows()
    assert len(read) == 21
    write_subject(runs, "subject_0000", "done", **{"novel_pose.psnr": 21.0})
    rows = table.rows()
    assert read[21:] == ["subject_0000"]
    assert next(row for row in rows if row.subject == "subject_0000").state == "done"


def test_csv_has_a_column_a_field_and_no_formula(tmp_path):
    runs = write_batch(tmp_path / "made", 20)
    write_index(runs)
    rows = list(csv.DictReader((runs / "summary.csv").read_text().splitlines()))
    assert len(rows) == 21 and list(rows[0]) == [field.name for field in fields(Row)]
    assert {row["convention"] for row in rows} <= {"", "1"}
    assert csv_text([Row("=cmd()", "done")]).splitlines()[1].startswith("'=cmd()")


def test_a_full_disk_costs_the_page_and_not_the_batch(tmp_path, monkeypatch, caplog):
    writer = IndexWriter(write_batch(tmp_path / "made", 4))
    monkeypatch.setattr("pipelines.batch.page.atomic_write_text", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
    writer.update()
    assert "not written" in caplog.text
    monkeypatch.undo()
    writer.update()  # it is not time yet
    assert not (tmp_path / "made" / "index.html").exists()
    assert len(writer.write()) == 5 and (tmp_path / "made" / "index.html").exists()


def test_the_terminal_shows_the_worst_and_counts_the_rest(tmp_path):
    rows = BatchTable(write_batch(tmp_path / "made", 60)).rows()
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(terminal_table(rows, most=5))
    text = console.export_text()
    # A reason has the width of the terminal: in a column it stood a word a line.
    assert "scan: expected one whole person, received two heads <b>& a" in text
    assert "56 more in index.html" in " ".join(text.split())


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
@pytest.mark.long
def test_the_page_sorts_filters_and_searches_in_a_browser(tmp_path):
    runs = write_batch(tmp_path / "made", 240)
    rows = write_index(runs, every=3600.0)
    address, shown = (runs / "index.html").as_uri(), "document.querySelector('#shown').textContent"
    assert (runs / "index.html").stat().st_size < 120_000
    with Page(tmp_path / "browser") as page:
        page.send("Page.navigate", url=address)
        page.until(f"document.readyState === 'complete' && {shown}")
        assert page.evaluate(shown) == "241 of 241 subjects, worst first"
        first = "document.querySelector('tbody th').textContent"
        assert page.evaluate(first) == rows[0].subject
        # Words of a record are text and never elements of the page.
        assert page.evaluate("document.querySelectorAll('tbody b').length") == 0
        assert "two heads <b>& a dog</b>" in page.evaluate("document.querySelector('.why').textContent")
        # It is laid out as far as it is looked at, and grows.
        assert page.evaluate("document.querySelectorAll('tbody th').length") < 150
        page.evaluate("document.querySelector('#more').click()")
        page.until("document.querySelectorAll('tbody th').length >= 200")
        page.evaluate("document.querySelector('[data-by=poses_psnr]').click()")
        lowest = min((row for row in rows if row.poses_psnr is not None), key=lambda row: row.poses_psnr)
        assert page.evaluate(first) == lowest.subject
        assert page.evaluate("document.querySelector('[aria-sort=ascending] button').dataset.by") == "poses_psnr"
        page.evaluate("document.querySelector('[data-state=failed]').click()")
        assert page.evaluate(shown) == "12 of 241 subjects"
        search = (
            "(one => {{ one.value = '{}'; one.dispatchEvent(new Event('input')); }})(document.querySelector('#find'))"
        )
        page.evaluate(search.format("0080 two heads"))
        assert page.evaluate(shown) == "1 of 241 subjects"
        # What was chosen stands in the address, so that a page from disk that loads itself again keeps it.
        page.send("Page.reload")
        page.until(f"document.readyState === 'complete' && {shown} === '1 of 241 subjects'")
        page.evaluate(search.format(""))
        for width, height, least in SIZES:
            page.resize(width, height)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert page.evaluate(SMALL.replace("LEAST", str(least))) == []
            if AXE.exists():
                page.evaluate(AXE.read_text() + ";0")
                assert page.evaluate(FINDINGS) == []
        # A newer state, as a served page polls it, keeps what was chosen.
        for name in ("subject_0020", "subject_0040"):
            write_subject(runs, name, "done", **{"novel_pose.psnr": 21.0})
        content = page_content(runs, BatchTable(runs).rows())
        page.evaluate(f"take({json.dumps(content)})")
        assert page.evaluate(shown) == "10 of 241 subjects"
        assert page.errors == []
