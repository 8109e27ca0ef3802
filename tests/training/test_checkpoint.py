"""Checkpoints: exact, of one training, and never half written."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from avatar.training.checkpoint import Checkpoint, load_checkpoint, save_checkpoint


def some(key: str = "this", iteration: int = 7) -> Checkpoint:
    values = torch.randn(5, 3, generator=torch.Generator().manual_seed(iteration))
    return Checkpoint(iteration, 1.25, key, {"a": values, "adam.step.a": torch.tensor(7.0), "b": values.T})


def test_round_trip_is_exact(tmp_path):
    save_checkpoint(tmp_path / "state", some())
    back = load_checkpoint(tmp_path / "state", key="this")
    assert back is not None and (back.iteration, back.seconds) == (7, 1.25)
    assert back.tensors.keys() == some().tensors.keys()
    assert all(torch.equal(value, some().tensors[name]) for name, value in back.tensors.items())


def test_other_trainings_damage_and_absence_mean_a_new_start(tmp_path):
    path = tmp_path / "state"
    assert load_checkpoint(path, key="this") is None
    save_checkpoint(path, some())
    assert load_checkpoint(path, key="that") is None
    path.write_bytes(path.read_bytes()[:-20])
    assert load_checkpoint(path, key="this") is None
    path.write_bytes(b"nonsense")
    assert load_checkpoint(path, key="this") is None


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
