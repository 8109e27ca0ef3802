"""A teacher that two real processes train together is that of one process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.engine.loop import LoopConfig, run_training
from avatar.training.engine.photometric_task import TaskContext
from avatar.training.engine.processes import Distributed, join_processes
from avatar.training.fit_teacher import FitTeacherConfig, TeacherTask
from tests.dolls.dancing import gaussians, sequence, write_dance
from tests.dolls.tiny import TINY_TEACHER
from tests.training.engine.test_photometric_tasks import STEPS

ROOT = Path(__file__).resolve().parents[2]


def teach(capture: Path, folder: Path, together: Distributed) -> None:
    """Process r begins with networks of its own, seed r; the first one's count."""
    torch.manual_seed(together.rank)
    frames = sequence(capture)
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, gaussians())
    config = FitTeacherConfig(pretrain=None, lr=1e-3, attributes=0.5, **{**STEPS, "poses_per_step": 4, "iterations": 4})
    task = TeacherTask(frames, teacher, config, TaskContext(distributed=together))
    run_training(task, LoopConfig(iterations=4, evaluate_every=4), folder, key="k")
    learned = {name: value.detach().contiguous() for name, value in task.learned.items()}
    save_file(learned, folder / f"learned_{together.rank}.safetensors")


@pytest.mark.slow
def test_two_processes_train_the_teacher_of_one(tmp_path):
    capture = write_dance(tmp_path / "capture")
    teach(capture, tmp_path / "one", Distributed())
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        __file__,
        str(capture),
        str(tmp_path / "two"),
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    one = load_file(tmp_path / "one" / "learned_0.safetensors")
    first, second = (load_file(tmp_path / "two" / f"learned_{rank}.safetensors") for rank in (0, 1))
    assert one.keys() == first.keys()
    for name, value in one.items():
        assert torch.equal(first[name], second[name]), name
        torch.testing.assert_close(first[name], value, rtol=0, atol=2e-4, msg=lambda text, n=name: f"{n} {text}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    with join_processes() as processes:
        teach(Path(sys.argv[1]), Path(sys.argv[2]), processes)
