from __future__ import annotations

import json
import os

import numpy as np
import pytest

from pipelines.runs.code import sha256_file
from pipelines.runs.folders import LOCK_NAME, own_run_folder
from pipelines.runs.stage import StageOutput, decide, differences, read_manifest, require_stage, run_stage, standing
from smplxpp.core import Check, InputError
from smplxpp.core.files.atomic import atomic_folder, atomic_write_text
from tests.runs.stages import stage_of


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
    first = run_stage(tmp_path, stage_of("20_segment", config={"a": 1}, inputs={"scan": "x"}), work)
    again = run_stage(tmp_path, stage_of("20_segment", config={"a": 1}, inputs={"scan": "x"}), work)
    assert (first.ran, again.ran, work.runs) == (True, False, 1)
    assert again.manifest == first.manifest
    assert first.manifest["checks"][0]["status"] == "pass"
    assert first.manifest["numbers"] == {"count": 3}


@pytest.mark.parametrize("change", ["config", "inputs", "file", "manifest", "force"])
def test_whatever_changes_runs_the_stage_again(tmp_path, change):
    work, config, inputs = Work(), {"a": 1}, {"scan": "x"}
    folder = run_stage(tmp_path, stage_of("s", config=config, inputs=inputs), work).folder
    if change == "config":
        config = {"a": 2}
    elif change == "inputs":
        inputs = {"scan": "y"}
    elif change == "file":
        (folder / "data.txt").write_text("tampered")
    elif change == "manifest":
        (folder / "manifest.json").write_text("{")
    assert run_stage(tmp_path, stage_of("s", config=config, inputs=inputs), work, force=change == "force").ran
    assert work.runs == 2
    assert (folder / "data.txt").read_text() == "result"


def test_a_failed_stage_leaves_the_finished_one_and_nothing_else(tmp_path):
    run_stage(tmp_path, stage_of("s", config={"a": 1}, inputs={}), Work())
    with pytest.raises(RuntimeError):
        run_stage(tmp_path, stage_of("s", config={"a": 2}, inputs={}), Work(fail=True))
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
    stage = stage_of("s", config={"p": tmp_path})
    record = run_stage(tmp_path, stage, lambda folder: StageOutput(numbers={"x": float("nan")}))
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


class Training:
    """A resumable stage that is stopped after some of its steps."""

    def __init__(self, run, *, config=None, steps: int = 4) -> None:
        self.run, self.steps = run, steps
        self.stage = stage_of("80_teacher", config=config or {"lr": 0.1}, resumable=True)
        self.state = run / self.stage.work_name / "state.safetensors"

    def __call__(self, *, stop: int | None = None, kill: bool = False, force: bool = False):
        def work(folder):
            done = int(self.state.read_text()) if self.state.exists() else 0
            end = self.steps if stop is None else min(self.steps, done + stop)
            self.state.write_text(str(end))
            if kill:
                raise RuntimeError("killed")
            (folder / "model.txt").write_text(str(end))
            return StageOutput(numbers={"finished": end == self.steps, "began": done})

        return run_stage(self.run, self.stage, work, force=force)


def test_an_interrupted_stage_goes_on_and_leaves_no_state_when_finished(tmp_path):
    training = Training(tmp_path)
    with pytest.raises(RuntimeError):
        training(stop=1, kill=True)
    assert decide(tmp_path, training.stage) == "resume" and not (tmp_path / "80_teacher").exists()
    stopped = training(stop=2)
    assert stopped.manifest["numbers"]["began"] == 1 and not stopped.finished
    assert decide(tmp_path, training.stage) == "resume"
    finished = training()
    assert finished.manifest["numbers"]["began"] == 3 and finished.finished
    assert not training.state.parent.exists()
    assert decide(tmp_path, training.stage) == "skip" and not training().ran


def test_the_state_of_another_stage_is_refused_in_words_and_kept(tmp_path):
    Training(tmp_path)(stop=1)
    other = Training(tmp_path, config={"lr": 0.2})
    with pytest.raises(InputError, match=r"config lr was 0.1, is 0.2.*--force"):
        other()
    assert other.state.read_text() == "1"
    assert other(force=True).manifest["numbers"]["began"] == 0


def test_state_without_a_checkpoint_is_not_worth_refusing(tmp_path):
    training = Training(tmp_path)
    training.state.parent.mkdir(parents=True)
    (training.state.parent / "metrics.jsonl").write_text("{}")
    assert decide(tmp_path, training.stage) == "redo"
    assert training().manifest["numbers"]["began"] == 0


def test_the_folder_is_no_part_of_the_key(tmp_path):
    assert stage_of("90_compensate").key == stage_of("ablation/full").key
    made = run_stage(tmp_path, stage_of("90_compensate"), Work())
    assert standing(tmp_path / "90_compensate", stage_of("ablation/full")).manifest == made.manifest


def test_a_difference_names_what_changed(tmp_path):
    old, new = (stage_of("s", config={"a": {"b": k}, "c": 1}, inputs={"x": f"{k}"}) for k in (1, 2))
    assert differences(old.recorded, new) == "config a.b was 1, is 2; inputs x"
    assert "missing" in differences(old.recorded, old)


def test_a_training_anew_that_was_killed_goes_on_without_force(tmp_path):
    training = Training(tmp_path)
    training()
    with pytest.raises(RuntimeError):
        training(stop=3, kill=True, force=True)
    assert decide(tmp_path, training.stage) == "resume"
    with pytest.raises(RuntimeError):
        training(stop=0, kill=True)
    assert training().manifest["numbers"]["began"] == 3
    assert decide(tmp_path, training.stage) == "skip" and not training.state.parent.exists()


def test_the_state_of_another_training_outlives_a_stage_that_stands(tmp_path, caplog):
    training, other = Training(tmp_path), Training(tmp_path, config={"lr": 0.2})
    training()
    with pytest.raises(RuntimeError):
        other(stop=1, kill=True)
    assert not training().ran and other.state.read_text() == "1"
    assert "the state of another training" in caplog.text
    assert other().manifest["numbers"]["began"] == 1


def test_what_a_finished_training_is_replaced_for_is_told(tmp_path, caplog):
    Training(tmp_path)()
    assert "replaces" not in caplog.text
    Training(tmp_path, config={"lr": 0.2})()
    assert "replaces a different one: config lr was 0.1, is 0.2" in caplog.text


def test_pipes_are_neither_digested_nor_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="regular file"):
        sha256_file(tmp_path / "pipe")
    os.mkfifo(tmp_path / LOCK_NAME)
    with pytest.raises(InputError, match="can be written"), own_run_folder(tmp_path, ()):
        pass
