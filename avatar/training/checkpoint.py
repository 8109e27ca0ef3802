"""Where a training stands, in one file: tensors of any names, an iteration, and what the training is of."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from smplxpp.core.atomic import atomic_write_bytes

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A training after `iteration` steps.

    Attributes:
        iteration: steps done.
        seconds: time they took, all sessions together.
        key: names the configuration and inputs; a training goes on only from a checkpoint of its own key.
        tensors: parameters and the optimiser's state by name.
    """

    iteration: int
    seconds: float
    key: str
    tensors: Mapping[str, Tensor]


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint as safetensors, whole or not at all: a kill leaves the one before."""
    about = {"iteration": checkpoint.iteration, "seconds": checkpoint.seconds, "key": checkpoint.key}
    tensors = {name: value.detach().cpu().contiguous() for name, value in checkpoint.tensors.items()}
    atomic_write_bytes(path, save(tensors, metadata={"training": json.dumps({"schema": SCHEMA, **about})}))


def load_checkpoint(path: str | Path, *, key: str) -> Checkpoint | None:
    """The checkpoint in a file, bit for bit; None where there is none, or one that is damaged or of another training.

    Starting over is the right answer to each of these: nothing but time is lost.
    """
    try:
        with safe_open(Path(path), framework="pt") as file:
            about = json.loads((file.metadata() or {})["training"])
            if about["schema"] != SCHEMA or about["key"] != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError, KeyError, ValueError):
        return None
    return Checkpoint(int(about["iteration"]), float(about["seconds"]), key, tensors)
