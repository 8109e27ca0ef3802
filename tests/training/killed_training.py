"""What test_killed starts: a training that is killed again and again, and then one that is not.

    python killed_training.py FOLDER KILLS

Prints the iteration of the checkpoint after each kill. Children are forks, so that torch is imported but once.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from avatar.training.engine.adam import OptimiserConfig
from avatar.training.engine.checkpoints import STATE_FILE
from avatar.training.engine.loop import LoopConfig, run_training
from tests.dolls.toy import Toy

STEPS = 330


def train(folder: Path) -> None:
    """Train to the end, and leave the parameters there."""
    task = Toy(OptimiserConfig(iterations=STEPS))
    loop = LoopConfig(iterations=STEPS, log_every=10, evaluate_every=100, checkpoint_seconds=0.005)
    run_training(task, loop, folder, key="k")
    save_file({name: value.detach() for name, value in task.state().items()}, folder / "end.safetensors")


def child(folder: Path) -> int:
    """The process id of a training in a fork."""
    process = os.fork()
    if not process:
        train(folder)
        os._exit(0)
    return process


def main(folder: Path, kills: int) -> None:
    torch.set_num_threads(1)
    Toy(OptimiserConfig(iterations=1))  # what torch imports late is imported once
    moments, random = [0], np.random.default_rng()
    state = folder / "killed" / STATE_FILE
    for _ in range(kills):
        process = child(folder / "killed")
        goal = moments[-1] + random.integers(STEPS // (kills + 1))
        while iteration(state) < goal:
            time.sleep(0.001)
        time.sleep(random.uniform(0.0, 0.01))
        os.kill(process, signal.SIGKILL)
        status = os.waitpid(process, 0)[1]
        assert os.WIFSIGNALED(status), "it ended before it was killed"
        moments.append(iteration(state))
    for name in ("killed", "whole"):
        assert os.waitpid(child(folder / name), 0)[1] == 0
    sys.stdout.write(json.dumps(moments[1:]))


def iteration(state: Path) -> int:
    """Of a checkpoint, 0 where there is none yet."""
    if not state.is_file():
        return 0
    with safe_open(state, framework="pt") as file:
        return json.loads(file.metadata()["training"])["iteration"]


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
