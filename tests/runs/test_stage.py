from __future__ import annotations

import json

import numpy as np
import pytest

from pipelines.runs.checks import Check
from pipelines.runs.stage import StageOutput, read_manifest, require_stage, run_stage
from smplxpp.core.atomic import atomic_folder, atomic_write_text
from smplxpp.core.errors import InputError


class Work:
    """A stage that counts how often it ran."""

    def __init__(self, *, fail: bool = False) -> None:
        self.runs, self.fail = 0, fail

    def __call__(self, folder):
        self.runs += 1
        (folder / "data.txt").write_text("result")
        if self.fail:
            raise RuntimeError("killed")
        return StageOutput([Check("error", 0.5, "mm", 1.0, 2.0)], {"count": np.int64(3)})


def test_a_stage_that_stands_is_skipped(tmp_path):
    work = Work()
    first = run_stage(tmp_path, "20_segment", work, config={"a": 1}, inputs={"scan": "x"})
    again = run_stage(tmp_path, "20_segment", work, config={"a": 1}, inputs={"scan": "x"})
    assert (first.ran, again.ran, work.runs) == (True, False, 1)
    assert again.manifest == first.manifest
    assert first.manifest["checks"][0]["status"] == "pass"
    assert first.manifest["numbers"] == {"count": 3}


@pytest.mark.parametrize("change", ["config", "inputs", "file", "manifest", "force"])
def test_whatever_changes_runs_the_stage_again(tmp_path, change):
    work, config, inputs = Work(), {"a": 1}, {"scan": "x"}
    folder = run_stage(tmp_path, "s", work, config=config, inputs=inputs).folder
    if change == "config":
        config = {"a": 2}
    elif change == "inputs":
        inputs = {"scan": "y"}
    elif change == "file":
        (folder / "data.txt").write_text("tampered")
    elif change == "manifest":
        (folder / "manifest.json").write_text("{")
    assert run_stage(tmp_path, "s", work, config=config, inputs=inputs, force=change == "force").ran
    assert work.runs == 2
    assert (folder / "data.txt").read_text() == "result"


def test_a_failed_stage_leaves_the_finished_one_and_nothing_else(tmp_path):
    run_stage(tmp_path, "s", Work(), config={"a": 1}, inputs={})
    with pytest.raises(RuntimeError):
        run_stage(tmp_path, "s", Work(fail=True), config={"a": 2}, inputs={})
    assert read_manifest(tmp_path / "s")["config"] == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_require_stage_names_the_missing_one(tmp_path):
    with pytest.raises(InputError, match="stage 30_clean"):
        require_stage(tmp_path, "30_clean")


@pytest.mark.parametrize(
    ("value", "higher", "status"),
    [(0.5, False, "pass"), (1.5, False, "warn"), (2.5, False, "fail"), (float("nan"), False, "fail")],
)
def test_upper_gates(value, higher, status):
    assert Check("x", value, "mm", 1.0, 2.0, higher_is_better=higher).status == status


@pytest.mark.parametrize(("value", "status"), [(0.99, "pass"), (0.9, "warn"), (0.5, "fail")])
def test_lower_gates(value, status):
    assert Check("x", value, "", 0.95, 0.8, higher_is_better=True).status == status


def test_manifest_is_plain_json_without_nan(tmp_path):
    record = run_stage(
        tmp_path, "s", lambda folder: StageOutput(numbers={"x": float("nan")}), config={"p": tmp_path}, inputs={}
    )
    text = (record.folder / "manifest.json").read_text()
    assert json.loads(text)["numbers"]["x"] is None
    assert "NaN" not in text
    assert str(tmp_path) not in text


def test_atomic_text_replaces_whole(tmp_path):
    path = tmp_path / "new" / "a.txt"
    atomic_write_text(path, "one")
    atomic_write_text(path, "two")
    assert path.read_text() == "two"
    assert len(list(path.parent.iterdir())) == 1


def test_atomic_folder_is_readable_by_others(tmp_path):
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "x").write_text("1")
    plain = tmp_path / "plain"
    plain.mkdir()
    assert (tmp_path / "out").stat().st_mode == plain.stat().st_mode
