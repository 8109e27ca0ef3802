"""Checkpoints: exact, of one training, and never half written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from avatar.training.engine.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from smplxpp.core.errors import InputError


def some(key: str = "this", iteration: int = 7) -> Checkpoint:
    values = torch.randn(5, 3, generator=torch.Generator().manual_seed(iteration))
    return Checkpoint(iteration, 1.25, key, {"a": values, "adam.step.a": torch.tensor(7.0), "b": values.T})


def test_round_trip_is_exact(tmp_path):
    save_checkpoint(tmp_path / "state", some())
    back = load_checkpoint(tmp_path / "state", key="this")
    assert back is not None and (back.iteration, back.seconds) == (7, 1.25)
    assert back.tensors.keys() == some().tensors.keys()
    assert all(torch.equal(value, some().tensors[name]) for name, value in back.tensors.items())


def test_damage_and_absence_mean_a_new_start_and_damage_is_told(tmp_path, caplog):
    path = tmp_path / "state"
    assert load_checkpoint(path, key="this") is None
    assert not caplog.records
    save_checkpoint(path, some())
    for content in (path.read_bytes()[:-20], b"nonsense", b"", save({"a": torch.zeros(1)})):
        caplog.clear()
        path.write_bytes(content)
        assert load_checkpoint(path, key="this") is None
        assert "cannot be read" in caplog.text


def test_one_of_another_training_is_refused_and_stays(tmp_path):
    path = tmp_path / "state"
    save_checkpoint(path, some())
    content = path.read_bytes()
    with pytest.raises(InputError, match="at iteration 7") as caught:
        load_checkpoint(path, key="that")
    assert str(path) in caught.value.subject and "--force" in caught.value.remedy
    assert path.read_bytes() == content


def test_one_of_a_newer_version_is_refused_by_its_number(tmp_path):
    path = tmp_path / "state"
    path.write_bytes(save({"later": torch.zeros(1)}, metadata={"training": json.dumps({"schema": 4, "steps": "many"})}))
    with pytest.raises(InputError, match=r"expected version 1 of the format, received version 4\. Continue with"):
        load_checkpoint(path, key="this")


def test_a_kill_while_writing_leaves_the_one_before(tmp_path, monkeypatch):
    path = tmp_path / "state"
    save_checkpoint(path, some(iteration=1))

    whole = Path.write_bytes

    def killed(target, data):
        whole(target, data[: len(data) // 2])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "write_bytes", killed)
        save_checkpoint(path, some(iteration=2))
    assert load_checkpoint(path, key="this").iteration == 1
    assert [p.name for p in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize(
    "about",
    [
        [1],
        "words",
        7,
        None,
        {},
        {"schema": 1, "key": "this"},
        {"schema": 1, "key": "this", "iteration": "many", "seconds": 1.0},
        {"schema": 1, "key": "this", "iteration": -3, "seconds": 1.0},
        {"schema": 1, "key": "this", "iteration": 3, "seconds": None},
        {"schema": 1, "key": "this", "iteration": 3, "seconds": float("nan")},
    ],
)
def test_metadata_of_another_kind_means_a_new_start(about, tmp_path, caplog):
    (tmp_path / "state").write_bytes(save({"a": torch.zeros(1)}, metadata={"training": json.dumps(about)}))
    assert load_checkpoint(tmp_path / "state", key="this") is None
    assert "cannot be read" in caplog.text


@pytest.mark.parametrize("found", [None, [], {"a": 1}, 5])
def test_keys_of_another_kind_are_those_of_another_training(found, tmp_path):
    about = {"schema": 1, "key": found, "iteration": [9], "seconds": 0}
    (tmp_path / "state").write_bytes(save({"a": torch.zeros(1)}, metadata={"training": json.dumps(about)}))
    with pytest.raises(InputError, match="one of others"):
        load_checkpoint(tmp_path / "state", key="this")
