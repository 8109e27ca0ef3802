"""`smplxpp ablate` on a moving doll: files, one table, what stands, and what it refuses."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from benchmarks.accuracy.ablation import AblationBenchmark
from benchmarks.support import results as store
from pipelines.cli import main
from smplxpp.core import BodyParams, InputError
from tests.dolls.swaying import ANGLES, HEIGHT, WIDTH, params, write_moving_capture, write_moving_run

QUICK = (
    *("--preset", "demo", "--iterations-share", "0.01", "--gaussians", "400", "--every", "3", "--device", "cpu"),
    *("--metric", "none", "--samples", "0"),
)
ROWS = ("no-gaussians", "lbs")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_moving_capture(tmp_path_factory.mktemp("doll") / "capture")


def ablate(run, capture, *options: str) -> int:
    return main(["ablate", str(run), "--capture", str(capture), *QUICK, "--rows", *ROWS, *options])


@pytest.fixture(scope="module")
def finished(tmp_path_factory, capture):
    run = write_moving_run(tmp_path_factory.mktemp("run"))
    assert ablate(run, capture) == 0
    return run


def test_table_figures_and_pictures(finished, capsys, capture, monkeypatch):
    folder = finished / "ablation"
    with open(folder / "table.csv") as file:
        rows = list(csv.DictReader(file))
    assert [row[""] for row in rows] == ["w/o Gau Non.", "LBS Gaussians"]
    results = json.loads((folder / "results.json").read_text())
    assert results["waiting"] == [] and results["rows"]["lbs"]["title"] == "LBS Gaussians"
    assert float(rows[1]["novel_view.psnr"]) == results["rows"]["lbs"]["figures"]["novel_view.psnr"]
    assert results["preset"]["fit"]["sampling"]["count"] == 400
    assert results["command"].startswith("smplxpp ablate RUN --capture DIR --preset demo --rows no-gaussians lbs")
    assert "--iterations-share 0.01 --gaussians 400" in results["command"] and "device" not in results["command"]
    assert "w/o Gau Non." in (folder / "table.txt").read_text() and "toprule" in (folder / "table.tex").read_text()
    names = {path.stem for path in (folder / "pictures").glob("*.png")}
    assert {"novel_view_Held_000000", "novel_pose_Held_000004"} <= names
    with Image.open(folder / "pictures" / "novel_pose_Held_000004.png") as strip:
        assert strip.width == 3 * WIDTH + 2 * 4 and strip.height > HEIGHT  # photograph and two rows
        shown = np.asarray(strip)[:HEIGHT, :WIDTH]
    with Image.open(capture / "rgbs" / "Held" / "Held_rgb000004.png") as photograph:
        assert np.array_equal(shown, np.asarray(photograph))
    # The same again trains nothing, and prints the same table; its pictures go on in a second line where one is full.
    monkeypatch.setattr("pipelines.ablation.ablate.COLUMNS", 2)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("manifest.json")}
    capsys.readouterr()
    assert ablate(finished, capture) == 0
    assert "w/o Gau Non." in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("manifest.json")}
    with Image.open(folder / "pictures" / "novel_pose_Held_000004.png") as sheet:
        assert sheet.width == 2 * WIDTH + 4 and sheet.height > 2 * HEIGHT
        assert np.array_equal(np.asarray(sheet)[:HEIGHT, :WIDTH], shown)


@pytest.mark.long
def test_held_out_poses_that_a_run_refined_are_measured_beside_the_given_ones(tmp_path, capture):
    run = write_moving_run(tmp_path / "run")
    assert ablate(run, capture) == 0
    results = run / "ablation" / "results.json"
    given = json.loads(results.read_text())
    assert not any(key.startswith("refined.") for key in given["rows"]["lbs"]["figures"])
    trained = {path: path.stat().st_mtime_ns for path in (run / "ablation").glob("*/*.safetensors")}
    poses = [params(frame) for frame in range(len(ANGLES))]
    away = [replace(one, transl=one.transl + (0.05, 0.0, 0.0)) for one in poses]
    (run / "66_refine").mkdir()
    BodyParams.concatenate(away).save(run / "66_refine" / "params_held_out.npz")
    assert ablate(run, capture) == 0
    again = json.loads(results.read_text())
    assert trained == {path: path.stat().st_mtime_ns for path in (run / "ablation").glob("*/*.safetensors")}
    for name in ROWS:
        figures, title = again["rows"][name]["figures"], again["rows"][name]["title"]
        same = {key: value for key, value in figures.items() if not key.startswith("refined.")}
        assert same == given["rows"][name]["figures"]
        assert figures["refined.novel_pose.images"] == figures["novel_pose.images"]
        assert figures["refined.novel_pose.psnr"] < figures["novel_pose.psnr"] - 0.3  # somebody who stands elsewhere
        assert set(again["evaluation"]["refined_poses"][title]["views"]) == {"novel_pose"}
        assert again["evaluation"]["models"][title] == given["evaluation"]["models"][title]
    with open(run / "ablation" / "table.csv") as file:
        (row,) = [row for row in csv.DictReader(file) if row[""] == "LBS Gaussians"]
    assert float(row["refined.novel_pose.psnr"]) == again["rows"]["lbs"]["figures"]["refined.novel_pose.psnr"]


def test_time_that_runs_out_is_told_and_the_same_command_goes_on(tmp_path, capture, capsys):
    run = write_moving_run(tmp_path / "run")
    assert ablate(run, capture, "--max-minutes", "1e-6") == 0
    assert (
        "still to do: gaussians, teacher, cloth, bake, lbs, no-gaussians; the same command continues"
        in capsys.readouterr().out
    )
    assert json.loads((run / "ablation" / "results.json").read_text())["rows"] == {}


def test_the_benchmark_stores_the_table_with_its_command(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(store, "RESULTS", tmp_path)
    AblationBenchmark(finished).run()
    stored = json.loads((tmp_path / "ablation_moving doll.json").read_text())
    assert "--iterations-share 0.01" in stored["command"] and stored["figures"]["gaussians"] == 400
    lbs = stored["figures"]["rows"]["LBS Gaussians"]
    assert lbs["what"] and lbs["novel_view.psnr"] > 0 and lbs["iterations"] > 0
    with pytest.raises(InputError, match="expected finished rows"):
        AblationBenchmark(tmp_path).run()


def test_what_is_refused_before_work_starts(tmp_path, capture, capsys):
    run = write_moving_run(tmp_path / "run")
    for options, message in (
        (("--rows", "everything"), "ablation rows"),
        (("--max-minutes", "0"), "option max-minutes"),
        (("--iterations-share", "-1"), "option iterations-share"),
        (("--seed", "-3"), "option seed"),
        (("--every", "0"), "evaluation: every"),
    ):
        assert ablate(run, capture, *options) == 2
        assert message in capsys.readouterr().err
    assert ablate(tmp_path / "empty", capture) == 2
    assert "smplxpp build" in capsys.readouterr().err
    assert not (run / "ablation").exists()
