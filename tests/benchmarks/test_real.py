"""The benchmark of real people: a folder of sources is run, measured and stored; docs/real.md is its result."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks.accuracy import real as real_module
from benchmarks.accuracy.real import (
    Ran,
    Real,
    last_words,
    line,
    outcome,
    run_command,
    stored_rows,
    summary,
    with_assessment,
)
from benchmarks.support import real_sources
from benchmarks.support.page import PAGES, page
from benchmarks.support.real_sources import KINDS, SOURCES, Source, Truth, chosen_sources
from benchmarks.support.real_truth import distances
from benchmarks.support.results import RESULTS, ROOT
from pipelines.runs.layout import LOCATE_STAGE, LOCATED_PARAMS, LOCATION_FILE, METRICS_FILE
from smplxpp.body import load_body
from smplxpp.body.smpl_joints import smpl_joints
from smplxpp.core import BodyParams, InputError
from tests.dolls.standing import write_run

SHIFT = 0.008
CHECKS = [
    {"name": "confidence of the body found", "value": 0.93, "status": "pass"},
    {"name": "upper: edge stretch p99.9", "value": 25.1, "status": "fail"},
]


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, body):
    """Sources of a bare body in centimetres, of which others say that it stands 8 mm farther to its left."""
    root = tmp_path_factory.mktemp("sources")
    params = BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions)
    posed = body.forward(params)
    kept = np.unique(body.faces[(body.part_labels == body.part_label_names.index("body"))[body.faces].all(axis=1)])
    back = np.full(body.vertex_count, -1)
    back[kept] = np.arange(len(kept))
    faces = back[body.faces]
    moved = 100.0 * (posed.vertices[0][kept] + [SHIFT, 0, 0])
    trimesh.Trimesh(moved, faces[(faces >= 0).all(axis=1)], process=False).export(root / "person.ply")
    np.savez(root / "joints.npz", joints=100.0 * (smpl_joints(body, params)[0] + [SHIFT, 0, 0]))
    return root


@pytest.fixture
def source(monkeypatch):
    """The only source there is: a scan with a known body."""
    one = Source(
        "doll", "a doll", "here", "ours", "scan", ("person.ply",), truth=Truth("person.ply", "joints.npz", "it")
    )
    other = Source("nobody", "nobody", "nowhere", "none", "scan", ("nobody.obj",))
    for module in (real_sources, real_module):
        monkeypatch.setattr(module, "SOURCES", (one, other))
    return one


def write_located_run(run: Path, body) -> None:
    """Write what a build leaves: a template, checks, the body found in a file of centimetres."""
    write_run(run)
    BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions).save(_made(run / LOCATED_PARAMS))
    (run / LOCATE_STAGE / LOCATION_FILE).write_text(json.dumps({"units": "cm", "up": "y"}))
    (run / METRICS_FILE).write_text(json.dumps({"checks": CHECKS}))


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def test_every_source_says_what_a_reader_must_know():
    assert len({source.key for source in SOURCES}) == len(SOURCES)
    for source in SOURCES:
        assert source.kind in KINDS and source.origin and source.licence and source.files, source.key
        assert source.after in {"", *(other.key for other in SOURCES)}
    clothed = {s.person.split(",")[0] for s in SOURCES if s.kind == "scan" and "underwear" not in s.person}
    assert len(clothed) >= 7


def test_sources_that_are_not_there_are_told_from_those_that_are(folder, source, tmp_path):
    there, absent = chosen_sources(folder)
    assert [one.key for one in there] == ["doll"] and [one.key for one in absent] == ["nobody"]
    with pytest.raises(InputError, match=r"person\.ply"):
        chosen_sources(tmp_path)
    with pytest.raises(InputError, match="dool"):
        chosen_sources(folder, ("dool",))


@pytest.mark.long
def test_a_failed_command_is_told_in_its_own_words(tmp_path):
    """The error's three parts reach the row, and time and memory are those of the command alone."""
    ran = run_command(["build", str(tmp_path / "run"), "--scan", str(tmp_path / "none.obj")], tmp_path / "log.txt")
    assert ran.status != 0 and 0.0 < ran.cpu_minutes and 0.02 < ran.memory_gib < 4.0
    assert outcome(ran, tmp_path / "run")["outcome"].startswith("stopped: ")
    assert "none.obj" in outcome(ran, tmp_path / "run")["outcome"]
    ran.save(tmp_path / "ran.json")
    assert Ran.load(tmp_path / "ran.json") == ran


def test_an_error_is_stored_without_the_machine_s_folders(folder, source, tmp_path):
    out, results = tmp_path / "out", tmp_path / "results"
    words = f"error: scan {folder}/person.ply: expected a person, received {out}/doll/run"
    (out / "doll").mkdir(parents=True)
    Ran(("build",), 2, 0.1, 0.1, 0.5, words).save(out / "doll" / "ran.json")
    Real(folder, out=out, again=True, results=results).run()
    (row,) = stored_rows(results).values()
    assert row["outcome"] == "stopped: error: scan DIR/person.ply: expected a person, received OUT/doll/run"


def test_notes_before_an_error_are_not_taken_for_it():
    text = "03_locate: 10 s\n╭──╮\n│ error: scan x: expected a person,  │\n│ received two.  │\n╰──╯\n"
    assert last_words(text) == "error: scan x: expected a person, received two."
    assert len(last_words("error: " + 400 * "x")) == 300


def test_a_known_body_is_measured_in_the_units_that_were_found(folder, source, body, tmp_path):
    """A body that stands 8 mm aside has joints 8 mm off, and a surface that is nearer: it slides along itself."""
    write_located_run(tmp_path / "run", body)
    found = distances(tmp_path / "run", folder, source.truth, body)
    assert found["joints"] == pytest.approx(1e3 * SHIFT, abs=0.05)
    assert found["own_joints"] > 30.0
    assert 0.2 * SHIFT < 1e-3 * found["surface"] < SHIFT and found["back"] == pytest.approx(found["surface"], rel=0.2)
    assert distances(tmp_path / "none", folder, source.truth, body) is None


@pytest.mark.long
def test_a_run_is_measured_drawn_and_stored(folder, source, body, tmp_path, capsys):
    out, results = tmp_path / "out", tmp_path / "results"
    write_located_run(out / "doll" / "run", body)
    Ran(("build",), 0, 3.25, 1.5, 0.5, "").save(out / "doll" / "ran.json")
    Real(folder, out=out, again=True, results=results).run()
    (row,) = stored_rows(results).values()
    assert row["outcome"] == "a template, 1 checks pass, 0 warn, 1 fail" and row["failed"] == [CHECKS[1]["name"]]
    assert (row["confidence"], row["minutes"], row["truth_mm"]["joints"]) == (0.93, 3.2, 8.0)
    assert row["command"] == "smplxpp build RUN --scan person.ply"
    assert np.asarray(Image.open(out / "doll" / "sheet.png")).std() > 5
    assert "not there: nobody" in capsys.readouterr().out
    assert str(tmp_path) not in (results / "real.json").read_text()


def test_an_assessment_stays_with_its_template_and_goes_with_another(folder, source, body, tmp_path):
    """Nobody has looked at a new template: what was written about the old one must not stand beside it."""
    seen = {"verdict": "right", "words": "every limb", "who": "by eye", "when": "2026-11-27"}
    row = {"made": "abc", "outcome": "done"}
    assert with_assessment(row, {"made": "abc", "assessment": seen})["assessment"] == seen
    assert with_assessment(row, {"made": "abd", "assessment": seen})["assessment"] is None
    assert with_assessment(row, {})["assessment"] is None


def test_a_folder_of_something_else_is_not_removed(folder, source, tmp_path):
    (tmp_path / "doll").mkdir()
    (tmp_path / "doll" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="another --out"):
        Real(folder, out=tmp_path, store=False).run()
    assert (tmp_path / "doll" / "thesis.txt").read_text() == "mine"


def test_the_page_is_what_the_stored_result_gives():
    text = (ROOT / "docs" / "real.md").read_text()
    assert ROOT / "docs" / "real.md" in PAGES and page(text) == text, "run `python -m benchmarks.support.page`"
    assert text.split("\n## ")[1].startswith("What fails a check")
    figures = json.loads((RESULTS / "real.json").read_text())["figures"]
    assert figures["summary"] == summary(figures["rows"])
    for row in figures["rows"]:
        assert f"| {row['source']} |" in text, row["source"]
        assert line(row).startswith(row["source"])


def test_the_lead_of_the_readme_is_the_stored_result():
    text = (ROOT / "README.md").read_text()
    figures = json.loads((RESULTS / "real.json").read_text())["figures"]["summary"]
    counts = re.search(
        r"Of (\d+) public scans .*?(\d+) end in a template, (\d+) of\s+these without a failed check", text
    )
    assert counts is not None
    assert [int(n) for n in counts.groups()] == [
        figures["scans"],
        figures["templates"],
        figures["without_a_failed_check"],
    ]
