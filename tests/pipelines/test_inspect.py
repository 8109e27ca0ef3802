"""`smplxpp inspect` on whole, partial and damaged runs."""

import json
from pathlib import Path

import numpy as np
import pytest

from avatar.formats.ply import write_splat_ply
from avatar.formats.splat_scenes import write_splat_glb
from avatar.formats.splats import Splats
from pipelines.cli import main
from pipelines.commands.inspect import Inspect, summarise_run
from pipelines.runs.layout import BUILD_STAGES, TEMPLATE_STAGES
from pipelines.runs.stage import StageOutput, run_stage
from smplxpp.core import Check, InputError
from tests.dolls.standing import dressed
from tests.runs.stages import stage_of


def add_stage(run, name, checks=()):
    def work(folder):
        (folder / "data.bin").write_bytes(bytes(1000))
        return StageOutput(checks=list(checks))

    return run_stage(run, stage_of(name), work)


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "dancer"
    good, doubtful = Check("mean error", 0.5, "mm", 1, 2), Check("p95 error", 4.0, "mm", 3, 6)
    for name in BUILD_STAGES:
        add_stage(folder, name, [good, doubtful] if name == BUILD_STAGES[-1] else [])
    (folder / "metrics.json").write_text(json.dumps({"schema": 1, "subject": "Dancer"}))
    (folder / "report.html").write_text("<!doctype html>")
    return folder


def test_a_whole_run(run):
    summary, checks = summarise_run(run)
    assert summary["subject"] == "Dancer" and summary["verdict"] == "warn"
    assert summary["counts"] == {"pass": 1, "warn": 1, "fail": 0}
    assert [stage["stage"] for stage in summary["stages"]] == list(BUILD_STAGES)
    assert all(stage["state"] == "done" and stage["bytes"] == 1000 for stage in summary["stages"])
    assert summary["unfinished"] == [] and summary["remedy"] is None
    assert summary["report"] == str(run / "report.html")
    assert [check.stage for check in checks] == [BUILD_STAGES[-1]] * 2


def test_a_run_under_way_names_what_is_missing_and_how_to_make_it(tmp_path, capsys):
    add_stage(tmp_path, TEMPLATE_STAGES[0])
    result = Inspect(tmp_path).run()
    assert result["unfinished"] == list(TEMPLATE_STAGES[1:]) and TEMPLATE_STAGES[1] in result["remedy"]
    printed = capsys.readouterr().out
    assert "missing" in printed and f"--from-stage {TEMPLATE_STAGES[1]}" in printed and "none yet" in printed


def test_damage_is_seen(run):
    (run / BUILD_STAGES[2] / "data.bin").unlink()
    (run / BUILD_STAGES[3] / "manifest.json").write_text("{broken")
    (run / "metrics.json").write_text("[]")
    summary, _ = summarise_run(run)
    states = {stage["stage"]: stage["state"] for stage in summary["stages"]}
    assert (
        states[BUILD_STAGES[2]] == "incomplete"
        and states[BUILD_STAGES[3]] == "unreadable"
        and states[BUILD_STAGES[4]] == "done"
    )
    assert summary["unfinished"] == [BUILD_STAGES[2], BUILD_STAGES[3]] and summary["subject"] is None


def test_a_stage_of_another_pipeline_is_listed_in_its_place(run):
    add_stage(run, "70_fit")
    names = [stage["stage"] for stage in summarise_run(run)[0]["stages"]]
    assert names == [*BUILD_STAGES, "70_fit"]


def test_metrics_alone_are_enough_for_the_checks(tmp_path):
    check = Check("mean error", 9.0, "mm", 1, 2).as_dict()
    (tmp_path / "metrics.json").write_text(json.dumps({"subject": "s", "checks": [{"stage": "65_validate", **check}]}))
    summary, checks = summarise_run(tmp_path)
    assert summary["verdict"] == "fail" and checks[0].stage == "65_validate"


@pytest.mark.parametrize("name", ["empty", "absent"])
def test_a_folder_without_a_run_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="run folder"):
        Inspect(tmp_path / name).run()


def test_the_terminal_lists_what_does_not_pass_and_all_on_request(run, capsys):
    Inspect(run).run()
    brief = capsys.readouterr().out
    assert "p95 error" in brief and "mean error" not in brief and "1 warn" in brief
    Inspect(run, all=True).run()
    assert "mean error" in capsys.readouterr().out


def test_json_and_exit_status(run, capsys):
    assert main(["inspect", str(run), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["counts"]["warn"] == 1
    add_stage(run, "70_fit", [Check("broken", 5, "", 1, 2)])
    assert main(["inspect", str(run)]) == 0
    assert main(["inspect", str(run), "--strict"]) == 1
    assert main(["inspect", str(run / "nothing")]) == 2


def test_a_training_that_the_time_stopped_is_unfinished(run, capsys):
    path = run / BUILD_STAGES[-1] / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps({**manifest, "numbers": {"finished": False}}))
    summary, _ = summarise_run(run)
    assert summary["stages"][-1]["state"] == "unfinished" and summary["unfinished"] == [BUILD_STAGES[-1]]
    Inspect(run).run()
    assert "unfinished" in capsys.readouterr().out


WRONG = [
    ("numbers", [1], "numbers: expected an object"),
    ("files", {"data.bin": 3}, "files: data.bin: expected a text"),
    ("files", {"../../data.bin": "0" * 64}, "inside of stage"),
    ("files", {"/dev/zero": "0" * 64}, "inside of stage"),
    ("inputs", ["a"], "inputs: expected an object"),
    ("seconds", "long", "seconds: expected a finite number"),
    ("seconds", float("nan"), "seconds: expected a finite number"),
    ("checks", {"a": 1}, "checks: expected a list"),
    ("checks", ["good"], "check: expected an object"),
    ("checks", [{"name": "a", "status": "grand"}], "status: expected fail or warn or pass"),
    ("checks", [{"name": "a", "status": "pass", "value": "much"}], "value: expected a finite number"),
    ("schema", [], "version 2"),
]


@pytest.mark.parametrize(("name", "value", "words"), WRONG)
def test_a_manifest_of_another_kind_is_a_row_that_says_so(name, value, words, run, capsys):
    path = run / BUILD_STAGES[1] / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    summary, _ = summarise_run(run)
    states = [stage["state"] for stage in summary["stages"]]
    assert states == ["done", "unreadable", *["done"] * (len(states) - 2)]
    assert words in summary["stages"][1]["problem"] and BUILD_STAGES[1] in summary["stages"][1]["problem"]
    Inspect(run).run()
    shown = " ".join(capsys.readouterr().out.split())
    assert words in shown and "p95 error" in shown


@pytest.mark.parametrize("content", [b"[" * 100_000, b'"words"', b"\xff\xfe", b"9" * 6000, b"null", b"{}"])
def test_bytes_that_are_no_manifest(content, run):
    (run / BUILD_STAGES[0] / "manifest.json").write_bytes(content)
    assert summarise_run(run)[0]["stages"][0]["state"] == "unreadable"


@pytest.mark.parametrize(
    "metrics", [[], 3, {"subject": ["a"]}, {"checks": 3}, {"checks": [3]}, {"checks": [{"name": 1}]}]
)
def test_metrics_of_another_kind_are_none(metrics, tmp_path):
    add_stage(tmp_path, BUILD_STAGES[0])
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    summary, checks = summarise_run(tmp_path)
    assert summary["subject"] is None and checks == []


def test_any_file_is_said_what_it_is(tmp_path, capsys):
    """Every file was answered with a folder "which does not exist"."""
    fixture = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
    (tmp_path / "broken.glb").write_text("hello")
    rows, ones = np.zeros((2, 3)), np.ones((2, 4))
    same = dict.fromkeys(("means", "normals", "f_dc", "log_scales"), rows)
    splats = Splats(**same, f_rest=np.zeros((2, 0, 3)), opacity_logits=np.zeros(2), quats=ones)
    write_splat_glb(tmp_path / "splats.glb", splats=splats)
    write_splat_ply(tmp_path / "splats.ply", splats=splats)
    (tmp_path / "film.mp4").write_bytes(b"....ftyp")
    (tmp_path / "words.json").write_text('{"a": 1}')
    dressed().save(tmp_path / "smplxpp.npz")
    for path, kind, fact in (
        (fixture, "capture", "8 cameras, 16 frames"),
        (fixture / "scans" / "scan_000000.ply", "mesh", "80,000 faces"),
        (fixture / "params" / "params.npz", "body parameters", "16 frames at 10 a second"),
        (tmp_path / "smplxpp.npz", "template", "parts by faces: body"),
        (tmp_path / "words.json", "JSON", "keys: a"),
        (tmp_path / "film.mp4", "film", "0.0 kB"),
        (tmp_path / "splats.glb", "splats of a pose, for other programs", "Gaussians without a surface"),
        (tmp_path / "splats.ply", "splats of a pose, for other programs", "Gaussians without a surface"),
        (tmp_path / "broken.glb", "nothing that is known here", "damaged: mesh file"),
    ):
        assert main(["inspect", str(path), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["kind"] == kind and any(fact in line for line in found["facts"]), found
        assert all(str(path) in step["command"] for step in found["next"])
    assert main(["inspect", str(fixture)]) == 0
    assert f"smplxpp build RUN --capture {fixture}" in capsys.readouterr().out
