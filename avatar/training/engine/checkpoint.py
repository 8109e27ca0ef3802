"""Where a training stands, in one file: tensors of any names, an iteration, and what the training is of."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.errors import InputError

SCHEMA = 1
log = logging.getLogger(__name__)


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
    """Write a checkpoint as safetensors, whole or not at all: a kill or a full disk leaves the one before."""
    about = {"iteration": checkpoint.iteration, "seconds": checkpoint.seconds, "key": checkpoint.key}
    tensors = {name: value.detach().cpu().contiguous() for name, value in checkpoint.tensors.items()}
    atomic_write_bytes(path, save(tensors, metadata={"training": json.dumps({"schema": SCHEMA, **about})}))


def load_checkpoint(path: str | Path, *, key: str) -> Checkpoint | None:
    """Return the checkpoint in a file, bit for bit; None where there is none or it cannot be read, which is logged.

    Raises:
        InputError: one of another training or of another version of the format. Hours may lie in it: only the user
            can say that it may go.
    """
    path = Path(path)
    if not path.exists():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})["training"])
            schema, found = about["schema"], {"key": None, **about}["key"]
            own = schema == SCHEMA and found == key
            tensors = {name: file.get_tensor(name) for name in file.keys()} if own else {}
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        log.warning("%s cannot be read (%s): the training starts over", path, error)
        return None
    if own:
        return Checkpoint(int(about["iteration"]), float(about["seconds"]), key, tensors)
    if schema != SCHEMA:
        raise InputError(
            f"checkpoint {path}",
            expected=f"version {SCHEMA} of the format",
            received=f"version {schema}",
            remedy="go on with the smplxpp that wrote it; to start anew, delete it (--force does)",
        )
    raise InputError(
        f"checkpoint {path}",
        expected="one of these options, inputs and code",
        received=f"one of others, at iteration {about.get('iteration')}",
        remedy="give the options that it was made with, or take another run folder; to start anew, delete it "
        "(--force does)",
    )
