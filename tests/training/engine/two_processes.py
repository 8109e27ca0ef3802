"""What `torchrun` starts for test_distributed: each process leaves its parameters and messages in a folder.

torchrun --standalone --nproc-per-node 2 two_processes.py FOLDER
"""

from __future__ import annotations

import errno
import json
import math
import os
import socket
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from safetensors.torch import save_file

from avatar.training.engine.adam import OptimiserConfig
from avatar.training.engine.checkpoints import Checkpoint
from avatar.training.engine.loop import LoopConfig, run_training
from avatar.training.engine.processes import Distributed, join_processes
from smplxpp.core.errors import InputError
from tests.dolls.toy import Toy

CONFIG = OptimiserConfig(iterations=20)


def loop(**changes) -> LoopConfig:
    often = {"iterations": 20, "log_every": 5, "evaluate_every": 10, "checkpoint_seconds": math.inf}
    return LoopConfig(**{**often, **changes})


def train(folder: Path, together: Distributed, config: LoopConfig | None = None, *, key: str = "k", **toy) -> Toy:
    """Process r begins with parameters of its own, seed r."""
    task = Toy(CONFIG, together, seed=together.rank, **toy)
    run_training(task, config or loop(), folder, key=key)
    return task


def refusal(work: Callable[[], object]) -> str:
    """The kind and message of the error that `work` ends with."""
    try:
        work()
    except (InputError, OSError, TypeError) as error:
        return f"{type(error).__name__}: {error}"
    return "no error"


def full_disk(*args) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def message() -> dict[Any, Any]:
    """Values of every kind that processes send each other."""
    numbers = torch.arange(6.0).reshape(2, 3)
    tensors = {
        "turned": numbers.T,
        "number": torch.tensor(0.1, dtype=torch.float64),
        "small": numbers.bfloat16(),
        "flags": numbers > 2,
        "none": torch.zeros(0, 3),
        "long": torch.tensor([1 << 40]),
    }
    said = [1, None, True, 0.1, math.inf, "\u00e4", ("of two", Path("a") / "b"), {3: [], "mapping": {}}]
    return {"said": said, "tensors": tensors, "kind": Checkpoint(3, 0.5, "k", tensors)}


def same(one: Any, other: Any) -> bool:
    """Whether two messages are of the same types and equal to the bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, Checkpoint):
        return same(vars(one), vars(other))
    if isinstance(one, dict):
        return list(one) == list(other) and same(list(one.values()), list(other.values()))
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def talk(together: Distributed) -> dict[str, Any]:
    """What comes of messages, and of those that cannot be sent or do not agree."""

    def only_first(value: Any) -> Any:
        assert together.first
        return value

    def open_file(rank: int = -1) -> int:
        warnings.warn("a file is small", UserWarning, stacklevel=1)
        if together.rank == rank:
            raise OSError(errno.EIO, "Input/output error")
        return together.rank

    shared = together.share_out(range(3), lambda k: {"number": torch.tensor(k / 3), "names": ["name"] * k})
    wanted = [{"number": torch.tensor(k / 3), "names": ["name"] * k} for k in range(3)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        own = together.run_on_all(open_file, lambda rank: "equal")
    return {
        "sent": same(together.run_on_rank0(lambda: only_first(message()), kinds=(Checkpoint,)), message()),
        "shared": same(shared, wanted),
        "own": own,
        "warned": len(caught),
        "unknown": refusal(lambda: together.run_on_rank0(lambda: only_first({1, 2}))),
        "apart": refusal(lambda: together.run_on_all(open_file, lambda rank: rank)),
        "broken": refusal(lambda: together.run_on_all(lambda: open_file(rank=1), lambda rank: 0)),
    }


def main(folder: Path) -> None:
    # torch's messages of objects are pickles; none may be sent.
    with join_processes() as together, mock.patch("torch.distributed.distributed_c10d._object_to_tensor", None):
        keep(train(folder / "whole", together), folder / f"whole_{together.rank}")
        limited = loop(max_seconds=1e-12)
        # By the clock of process 1 no time passes: it would never stop by itself.
        frozen = mock.patch.object(time, "perf_counter", lambda: 0.0) if together.rank else nullcontext()
        with frozen:
            train(folder / "parts", together, limited)
        keep(train(folder / "parts", together), folder / f"parts_{together.rank}")
        train(folder / "other", together, limited)
        report: dict[str, Any] = {
            "messages": talk(together),
            "diverged": refusal(lambda: train(folder / "diverged", together, poison=range(22, 99))),
            "few": refusal(lambda: train(folder / "few", together, batches=1)),
            "key": refusal(lambda: train(folder / "other", together, key="another")),
        }
        with mock.patch.object(Path, "write_bytes", full_disk):
            report["disk"] = refusal(lambda: train(folder / "disk", together, loop(checkpoint_seconds=0.0)))
        (folder / f"report_{together.rank}.json").write_text(json.dumps(report))


def keep(task: Toy, path: Path) -> None:
    save_file({name: value.detach() for name, value in task.state().items()}, path.with_suffix(".safetensors"))


def fork_two(folder: Path) -> int:
    """`main` in two processes with torchrun's environment; the number of those that failed."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    Toy(CONFIG)  # what torch imports late is imported once
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port), WORLD_SIZE="2")
    children = []
    for rank in (0, 1):
        child = os.fork()
        if not child:
            os.environ.update(RANK=str(rank), LOCAL_RANK=str(rank))
            main(folder)
            sys.exit(0)
        children.append(child)
    return sum(os.waitpid(child, 0)[1] != 0 for child in children)


if __name__ == "__main__":
    torch.set_num_threads(1)
    started = "RANK" in os.environ
    sys.exit(main(Path(sys.argv[1])) if started else fork_two(Path(sys.argv[1])))
