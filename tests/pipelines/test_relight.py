"""What `smplxpp evaluate` shows of a student in another light, and the report's section on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.report.sections.evaluation import relight_section, standing_relighting
from pipelines.runs.code import sha256_file
from pipelines.runs.stage import read_manifest
from tests.core.files.radiance import write_radiance
from tests.dolls.standing import dressed, write_frames
from tests.pipelines.test_evaluate import evaluate, write_dressed, write_models


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_frames(tmp_path_factory.mktemp("captures") / "doll")


@pytest.fixture(scope="module")
def run(tmp_path_factory, capture) -> Path:
    run = write_models(write_dressed(tmp_path_factory.mktemp("runs") / "lit"), dressed())
    assert evaluate(run, capture) == 0
    return run


def pictures(run: Path) -> dict[str, np.ndarray]:
    folder = run / "97_relight"
    shown = read_manifest(folder)["numbers"]["pictures"]
    return {said: np.asarray(Image.open(folder / file)).astype(float) for said, file in shown.items()}


def test_the_student_is_shown_before_and_after(run):
    before, *after = pictures(run).values()
    person = (before < 250).any(axis=2)
    empty = (before == 255).all(axis=2)
    assert 0.05 < person.mean() < 0.9 and len(after) == 3
    for k, image in enumerate(after):
        assert (image[empty] == 255).mean() > 0.99
        assert np.abs(image - before)[person].mean() > 5.0
        assert all(np.abs(image - other)[person].mean() > 3.0 for other in after[:k])


def test_the_report_shows_it_while_the_student_stands(run):
    digest = sha256_file(run / "60_assemble" / "smplxpp.npz")
    record = standing_relighting(run, digest)
    assert record is not None and standing_relighting(run, "0" * 64) is None
    section = relight_section(record)
    assert [picture.caption for picture in section.pictures][:2] == ["as captured", "relit"]
    assert "two lamps" in section.text[0] and len(section.comparisons) == 1


def test_it_is_drawn_once_and_anew_for_another_light(run, capture, tmp_path):
    stamp = (run / "97_relight" / "manifest.json").stat().st_mtime_ns
    assert evaluate(run, capture) == 0
    assert (run / "97_relight" / "manifest.json").stat().st_mtime_ns == stamp
    write_radiance(tmp_path / "red.hdr", np.ones((16, 32, 1)) * [1.0, 0.1, 0.1])
    options = ("--environment", str(tmp_path / "red.hdr"), "--exposure", "0.5")
    assert evaluate(run, capture, *options) == 0
    before, after, *_ = pictures(run).values()
    person = (before < 250).any(axis=2)
    gain = [after[person][:, k].mean() / before[person][:, k].mean() for k in range(3)]
    assert gain[0] > 1.5 * gain[1] and "red" in relight_section(standing(run)).text[0]
    assert evaluate(run, capture, "--environment", str(tmp_path / "none.hdr")) == 2


def standing(run: Path):
    record = standing_relighting(run, sha256_file(run / "60_assemble" / "smplxpp.npz"))
    assert record is not None
    return record
