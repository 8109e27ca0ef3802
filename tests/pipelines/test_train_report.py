"""The report's sections on trainings: pictures, figures, curves, and which trainings belong to the report."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from pipelines.report import Report, write_report
from pipelines.report.builder import readable
from pipelines.report.sections.training import (
    cloth_section,
    kind_name,
    standing_trainings,
    training_key_numbers,
    training_section,
)
from pipelines.runs.stage import StageRecord, read_manifest
from smplxpp.core import GeometryWarning, spread
from tests.pipelines.foreign_numbers import sections_of, with_foreign_numbers
from tests.pipelines.training_runs import STAGES


@pytest.fixture(scope="module")
def run(danced):
    return danced[1]


@pytest.fixture
def own(run, tmp_path):
    return shutil.copytree(run, tmp_path / "own")


def standing(run) -> dict[str, StageRecord]:
    fit = StageRecord(run / "70_fit", read_manifest(run / "70_fit"), ran=False)
    return standing_trainings(run, [fit])


def change(folder, **fields) -> None:
    """Rewrite fields of a manifest."""
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**manifest, **fields}))


def test_every_training_has_a_section_with_its_figures(run):
    for stage, title in zip(STAGES, ("Teacher", "Bake", "Compensation"), strict=True):
        record = standing(run)[stage]
        section, numbers = training_section(record), record.manifest["numbers"]
        assert section.title == title
        text = " ".join(section.text)
        assert "3 of 3 iterations" in text and "4 frames of 4 cameras" in text and ".safetensors" in text
        assert ("followed through the frames" in text) == (stage == "80_teacher")
        table = section.tables[0]
        states = ["start", "after 3 iterations", *(["the compact file"] if stage == "90_compensate" else [])]
        assert [row[:2] for row in table.rows] == [
            (kind, state) for kind in ("novel views", "novel poses") for state in states
        ]
        assert table.rows[1][2] == numbers["novel_view"]["psnr"]
        assert {check.stage for check in section.checks} == {stage}
        captions = [picture.caption for picture in section.pictures]
        assert sum(caption.startswith("Held0, frame") for caption in captions) == len(section.comparisons) == 4


def test_curves_follow_evaluations_and_steps(own):
    lines = [
        {"kind": "evaluation", "iteration": k, "seconds": 2.0 * k, "novel_view": {"psnr": 20.0 + k, "ssim": 0.9}}
        for k in range(3)
    ]
    lines += [{"kind": "step", "iteration": k, "seconds": 0.1 * k, "loss": 1.0 / k} for k in range(1, 1001)]
    (own / "85_bake" / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    psnr, ssim, loss = training_section(standing(own)["85_bake"]).curves
    np.testing.assert_array_equal(psnr.lines["novel views"], ([0.0, 2.0, 4.0], [20.0, 21.0, 22.0]))
    assert set(ssim.lines) == {"novel views"}
    seconds, values = loss.lines["training"]
    assert len(seconds) == len(values) == 300 and (np.diff(seconds) > 0).all() and (np.diff(values) < 0).all()


def test_numbers_of_another_program_are_told_in_the_place_of_the_section(run):
    records = with_foreign_numbers(standing(run)["90_compensate"], 25)
    read, told = sections_of(records, training_section, training_key_numbers)
    assert read and told


def test_a_log_with_foreign_figures_is_told(own):
    (own / "85_bake" / "metrics.jsonl").write_text('{"kind": "step", "iteration": 1, "loss": "low"}\n' * 3)
    record = standing(own)["85_bake"]
    with pytest.warns(GeometryWarning, match="85_bake cannot be read"):
        section = readable(record, "Bake", lambda: training_section(record))
    assert section.title == "Bake" and section.checks
    ours = StageRecord(record.folder, record.manifest, ran=True)
    with pytest.raises(KeyError):  # what this call has written is a mistake of ours
        readable(ours, "Bake", lambda: training_section(ours))


def test_key_numbers_are_those_of_a_training(run):
    records = standing(run)
    names = [number.label for number in training_key_numbers(records["90_compensate"])]
    assert names == [f"student, novel {kind}: PSNR of the person" for kind in ("views", "poses")]
    assert training_key_numbers(records["80_teacher"])[0].value == (
        f"{records['80_teacher'].manifest['numbers']['novel_view']['psnr']:.1f} dB"
    )


def test_trainings_of_files_that_were_made_anew_are_left_out(own):
    assert list(standing(own)) == ["80_teacher", "83_cloth", "85_bake", "90_compensate"]
    shutil.rmtree(own / "85_bake")
    assert list(standing(own)) == ["80_teacher", "83_cloth", "90_compensate"]
    inputs = read_manifest(own / "80_teacher")["inputs"]
    change(own / "80_teacher", inputs={**inputs, "70_fit/gaussians.safetensors": "other"})
    assert "80_teacher" not in standing(own)


def test_what_an_outdated_training_gave_on_is_outdated_too(own):
    inputs = read_manifest(own / "80_teacher")["inputs"]
    change(own / "80_teacher", inputs={**inputs, "70_fit/gaussians.safetensors": "other"})
    assert standing(own) == {}


def test_a_training_that_was_stopped_before_its_first_step_still_has_a_section(run, tmp_path):
    record = standing(run)["80_teacher"]
    folder = shutil.copytree(record.folder, tmp_path / "80_teacher")
    (folder / "metrics.jsonl").unlink()
    shutil.rmtree(folder / "previews")
    numbers = {name: value for name, value in record.manifest["numbers"].items() if not name.startswith("novel")}
    numbers |= {"start": {}, "measured_at": None, "finished": False}
    section = training_section(StageRecord(folder, {**record.manifest, "numbers": numbers}, ran=True))
    assert not section.curves and not section.comparisons and not section.tables[0].rows
    assert "limit of time" in " ".join(section.text)


def test_the_page_is_written(run, tmp_path):
    records = standing(run)
    sections = tuple(training_section(records[stage]) for stage in STAGES) + (cloth_section(records["83_cloth"]),)
    report = Report(
        subject="doll",
        summary="three trainings",
        hero=(),
        key_numbers=training_key_numbers(standing(run)["90_compensate"]),
        checks=(),
        seconds={},
        sections=sections,
        provenance={},
    )
    page = write_report(tmp_path / "report.html", report).read_text()
    assert all(section.title in page for section in sections) and "PSNR" in page


def test_names_and_spread():
    assert kind_name("novel_view", held_out=True) == "novel views"
    assert kind_name("novel_view", held_out=False) == "training views"
    assert kind_name("novel_pose", held_out=False) == "novel poses"
    assert spread([], 3) == [] and spread([5], 3) == [5]
    assert spread(range(10), 3) == [0, 4, 9] and spread(range(2), 4) == [0, 1]
