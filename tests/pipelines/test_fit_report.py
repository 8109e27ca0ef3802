"""The report's section on a fit: its pictures, figures and curves, and when a fit belongs to the report."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.cli import main
from pipelines.report import Curve, Report, write_report
from pipelines.report.builder import curve_svg
from pipelines.report.sections.build import rewrite_report
from pipelines.report.sections.fit import fit_key_numbers, fit_section, head_box, standing_fit
from pipelines.runs.code import sha256_file
from pipelines.runs.stage import StageRecord, read_manifest
from pipelines.stages.build_config import (
    BuildConfig,
    BuildInputs,
    RegisterInputs,
    load_build,
    load_register,
    save_build,
    save_register,
)
from smplxpp.core.errors import InputError
from smplxpp.figures import colormap
from smplxpp.figures.drawings import ERROR_LIMIT, enlarge, error_colors, error_legend, read_strip, write_strip
from tests.dolls.standing import HELD_OUT, TRAIN, write_capture, write_run
from tests.pipelines.foreign_numbers import sections_of, with_foreign_numbers

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> StageRecord:
    base = tmp_path_factory.mktemp("fit")
    run, capture = write_run(base / "run"), write_capture(base / "capture")
    options = ("--gaussians", "800", "--iterations", "4", "--device", "cpu", "--json")
    assert main(["fit", str(run), "--capture", str(capture), *options]) == 0
    return StageRecord(run / "70_fit", read_manifest(run / "70_fit"), ran=True)


def test_the_section_shows_every_held_out_camera_whole_and_the_head_enlarged(fitted):
    section = fit_section(fitted)
    captions = [picture.caption for picture in section.pictures]
    for name in HELD_OUT:
        assert f"{name}: photograph, rendered, error" in captions
        assert any(caption.startswith(f"{name}, head, ") for caption in captions)
    assert [pair.caption.split(",")[0] for pair in section.comparisons] == list(HELD_OUT)
    text = " ".join(section.text)
    assert "800 Gaussians" in text and "4 of 4 iterations" in text and "splats.ply" in text and "0.02" in text
    assert f"{ERROR_LIMIT} of 255" in text


def test_the_table_names_every_camera_and_both_means(fitted):
    table = fit_section(fitted).tables[0]
    assert [row[0] for row in table.rows] == [*HELD_OUT, "mean", *TRAIN, "mean"]
    held_out = fitted.manifest["numbers"]["held_out"]["Held0"]
    assert table.rows[0][2:5] == (held_out["psnr"], held_out["psnr_image"], held_out["ssim"])


def test_curves_follow_the_evaluations(fitted):
    psnr, ssim = fit_section(fitted).curves
    seconds, values = psnr.lines["person"]
    assert len(seconds) == len(values) == 5 and (np.diff(seconds) >= 0).all()
    assert values[-1] == pytest.approx(fitted.manifest["numbers"]["mean"]["held_out"]["psnr"])
    assert "novel" in psnr.title and "whole image" in ssim.lines


def test_the_page_is_written_with_it(fitted, tmp_path):
    path = write_report(tmp_path / "report.html", Report("doll", sections=(fit_section(fitted),)))
    html = path.read_text()
    assert "<span>Gaussians" in html and html.count("<polyline") == 3
    assert html.count("data:image/webp") + html.count("data:image/png") >= 9 and "http" not in html.replace(
        "http://www.w3.org", ""
    )


def test_without_held_out_cameras_it_says_so(fitted):
    manifest = json.loads(json.dumps(fitted.manifest))
    numbers = manifest["numbers"]
    numbers["held_out"] = {}
    numbers["mean"].pop("held_out")
    record = replace(fitted, manifest=manifest)
    assert "no camera is held out" in " ".join(fit_section(record).text)
    assert "training views (7)" in fit_key_numbers(record)[0].note
    assert "novel views (2)" in fit_key_numbers(fitted)[0].note


def test_a_fit_of_another_template_does_not_stand(fitted):
    run = fitted.folder.parent
    digest = sha256_file(run / "60_assemble" / "smplxpp.npz")
    assert standing_fit(run, digest).manifest == fitted.manifest
    assert standing_fit(run, "other") is None
    assert standing_fit(run.parent, digest) is None


def test_strips_keep_every_pixel_and_errors_their_scale(tmp_path):
    rng = np.random.default_rng(0)
    real, rendered = rng.integers(0, 256, (2, 12, 10, 3)).astype(np.uint8)
    write_strip(tmp_path / "strip.png", real, rendered)
    parts = read_strip(tmp_path / "strip.png")
    assert all(np.array_equal(a, b) for a, b in zip(parts[:2], (real, rendered), strict=True))
    same, worst = np.zeros((1, 1, 3), np.uint8), np.array([[[0, ERROR_LIMIT, 3]]], np.uint8)
    table = colormap("error")
    assert np.array_equal(error_colors(same, same)[0, 0], table[0])
    assert np.array_equal(error_colors(same, worst)[0, 0], table[-1])
    assert np.array_equal(error_colors(worst, same), error_colors(same, worst))
    assert np.array_equal(error_legend()[0, [0, -1]], table[[0, -1]])
    assert enlarge(real, 3).shape == (36, 30, 3) and np.array_equal(enlarge(real, 3)[1::3, 1::3], real)


def test_numbers_of_another_program_are_told_in_the_place_of_the_section(fitted):
    read, told = sections_of(with_foreign_numbers(fitted, 25), fit_section, fit_key_numbers)
    assert read and told


@pytest.mark.parametrize("box", [[0, 0, 10, 1], [0, 0, 0, 5], [-1, 0, 5, 5], [0, 0, 5], "none", [0, 0, 50, 5]])
def test_heads_outside_of_their_picture_are_refused(box):
    with pytest.raises(InputError, match="head in a picture"):
        head_box(box, np.zeros((20, 30, 3), np.uint8))
    assert head_box([1, 2, 9, 12], np.zeros((20, 30, 3), np.uint8)) == (1, 2, 9, 12)


def test_curves_are_drawn_from_finite_points():
    x = np.array([0.0, 10.0, 20.0, 30.0])
    svg = curve_svg(Curve("quality", {"a": (x, np.array([1.0, np.nan, 3.0, 4.0])), "b": (x, 2 * x)}, "seconds", "dB"))
    assert svg.count("<polyline") == 2 and svg.count("<circle") == 7
    assert 'aria-label="quality, at the end: a 4, b 60 dB"' in svg and "nan" not in svg
    assert curve_svg(Curve("one", {"a": (x[:1], x[:1])}, "seconds")).count("<circle") == 1
    with pytest.raises(InputError, match="finite point"):
        curve_svg(Curve("none", {"a": (x[:1], np.array([np.inf]))}, "seconds"))


def test_a_build_is_remembered_and_what_is_gone_left_out(tmp_path, caplog):
    scan, motion = tmp_path / "scan.ply", tmp_path / "motion.npz"
    motion.write_bytes(b"")
    maps = {"Cam1": tmp_path / "label.png"}
    inputs = BuildInputs("someone", scan, tmp_path / "params.npz", frame=3, label_maps=maps, motion=motion)
    config = BuildConfig(clearance_mm=2.0, budgets={"hair": 300})
    assert load_build(tmp_path) is None
    save_build(tmp_path, inputs, config)
    assert load_build(tmp_path) == (inputs, config) and not caplog.records
    motion.unlink()
    assert load_build(tmp_path) == (replace(inputs, motion=None), config)
    good = json.loads((tmp_path / "build.json").read_text())
    wrong: list[object] = [{}, [], 3, "words", {"config": 1, "inputs": 2}, {**good, "run": [1]}]
    for part in ("inputs", "config"):
        wrong.append({**good, part: []})
        wrong += [{**good, part: {**good[part], name: [[1]]}} for name in good[part]]
    for content in wrong:
        (tmp_path / "build.json").write_text(json.dumps(content))
        caplog.clear()
        assert load_build(tmp_path) is None and "build.json" in caplog.text, content
    (tmp_path / "build.json").write_text("[" * 50_000)
    assert load_build(tmp_path) is None
    (tmp_path / "build.json").write_bytes(b"\xff")
    save_build(tmp_path, inputs, config)  # one that nobody can read is written anew
    assert load_build(tmp_path) is not None


def test_a_registration_is_remembered_and_other_records_are_none(tmp_path, caplog):
    inputs = RegisterInputs(capture=tmp_path, frames=(1, 2), hold_out=("A",))
    save_register(tmp_path, inputs)
    assert load_register(tmp_path) == inputs and not caplog.records
    good = json.loads((tmp_path / "register.json").read_text())
    wrong: list[object] = [{}, [], 3, "words", *({**good, name: {"a": [1]}} for name in good)]
    for content in wrong:
        (tmp_path / "register.json").write_text(json.dumps(content))
        caplog.clear()
        assert load_register(tmp_path) is None and "register.json" in caplog.text, content


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")  # coarse parts; not what is tested
def test_the_report_of_a_build_gains_the_section_and_keeps_it(fitted, tmp_path):
    run = tmp_path / "run"
    build = [
        "build",
        str(run),
        "--capture",
        str(FIXTURE),
        "--budgets",
        "upper",
        "1500",
        "lower",
        "1500",
        "--json",
    ]
    assert main(build) == 0
    assert "<span>Gaussians" not in (run / "report.html").read_text()
    shutil.copytree(fitted.folder, run / "70_fit")
    manifest = json.loads((run / "70_fit" / "manifest.json").read_text())
    manifest["inputs"]["60_assemble/smplxpp.npz"] = sha256_file(run / "60_assemble" / "smplxpp.npz")
    (run / "70_fit" / "manifest.json").write_text(json.dumps(manifest))
    rewrite_report(run)
    assert "<span>Gaussians" in (run / "report.html").read_text()
    (run / "70_fit" / "manifest.json").touch()  # newer than the report: the next build writes it again
    (run / "report.html").write_text("old")
    (run / "70_fit" / "manifest.json").touch()
    assert main(build) == 0
    assert "<span>Gaussians" in (run / "report.html").read_text()
