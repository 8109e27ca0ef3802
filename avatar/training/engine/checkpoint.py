"""Checkpoints: tensors by name, the iteration, and a key of configuration and inputs, in one safetensors file."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors.torch import save
from torch import Tensor

from avatar.gaussians.tensor_file import open_tensor_file
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_number, shown

SCHEMA = 1
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of a training after `iteration` steps.

    Attributes:
        iteration: number of finished steps.
        seconds: their time over all sessions.
        key: digest of configuration and inputs; a training continues only from a checkpoint of its own key.
        tensors: parameters and the optimiser's state by name.
    """

    iteration: int
    seconds: float
    key: str
    tensors: Mapping[str, Tensor]


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint as safetensors, atomically: a kill or a full disk leaves the one before."""
    # One metadata entry, because safetensors writes several in an order that differs from run to run.
    about = {"iteration": checkpoint.iteration, "seconds": checkpoint.seconds, "key": checkpoint.key}
    tensors = {name: value.detach().cpu().contiguous() for name, value in checkpoint.tensors.items()}
    atomic_write_bytes(path, save(tensors, metadata={"training": json.dumps({"schema": SCHEMA, **about})}))


def load_checkpoint(path: str | Path, *, key: str) -> Checkpoint | None:
    """Return the checkpoint in a file; None where there is none or it cannot be read, which is logged.

    Raises:
        InputError: one of another training or of another version of the format. It may hold hours of work, so that
            only the user may delete it.
    """
    path = Path(path)
    if not path.exists():
        return None
    try:
        # A checkpoint of this key and version is read with checks of its header.
        file = open_tensor_file(path, subject=f"checkpoint {path}", header="training")
        schema, found = file.about["schema"], file.about.get("key")
        if schema == SCHEMA and found == key:
            iteration = as_integer(file.about.get("iteration"), subject="iteration", least=0)
            seconds = as_number(file.about.get("seconds"), subject="seconds", least=0.0)
            return Checkpoint(iteration, seconds, key, file.tensors())
    except (InputError, KeyError) as error:
        log.warning("%s cannot be read (%s): the training starts over", path, error)
        return None
    # A readable checkpoint that does not fit is never overwritten silently.
    if schema != SCHEMA:
        raise InputError(
            f"checkpoint {path}",
            expected=f"version {SCHEMA} of the format",
            received=f"version {shown(schema)}",
            remedy="continue with the smplxpp that wrote it; to start again, delete it (--force does)",
        )
    raise InputError(
        f"checkpoint {path}",
        expected="one of these options, inputs and code",
        received=f"one of others, at iteration {shown(file.about.get('iteration'))}",
        remedy="give the options that it was made with, or take another run folder; to start again, delete it "
        "(--force does)",
    )
