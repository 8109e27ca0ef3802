"""Checkpoints of a training: their file, and a thread that writes them beside the steps."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from safetensors.torch import save
from torch import Tensor

from avatar.gaussians.tensor_file import open_tensor_file
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_number, shown

SCHEMA = 1
STATE_FILE = "state.safetensors"
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of a training after `iteration` steps.

    Attributes:
        iteration: number of finished steps.
        seconds: their time over all sessions.
        key: digest of configuration and inputs; a training continues only from a checkpoint of its own key.
        tensors: parameters and the optimiser's state by name.
        diverged: number of those steps that were left out, because a loss or gradient was not finite.
    """

    iteration: int
    seconds: float
    key: str
    tensors: Mapping[str, Tensor]
    diverged: int = 0


def save_checkpoint(path: str | Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint as safetensors, atomically: a kill or a full disk leaves the one before."""
    # One metadata entry, because safetensors writes several in an order that differs from run to run.
    about: dict[str, Any] = {
        "iteration": checkpoint.iteration,
        "seconds": checkpoint.seconds,
        "key": checkpoint.key,
        "diverged": checkpoint.diverged,
    }
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
            diverged = as_integer(file.about.get("diverged", 0), subject="diverged", least=0)
            return Checkpoint(iteration, seconds, key, file.tensors(), diverged)
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


class CheckpointWriter:
    """Writes checkpoints in a thread, one at a time, while the next steps run.

    Args:
        path: of the file.
        share: of the time that checkpoints may take together.
        least_seconds: shortest interval between two.
    """

    def __init__(self, path: Path, *, share: float = 0.02, least_seconds: float = 30.0) -> None:
        self.path, self.share, self.least_seconds = path, share, least_seconds
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._pending: Future[float] | None = None

    def write(self, checkpoint: Checkpoint) -> float:
        """Copy a checkpoint's tensors and begin to write them; return the seconds until the next one is due.

        Raises:
            OSError: the checkpoint before this one could not be written.
        """
        begin = time.perf_counter()
        took = self.finish()
        # The steps go on with the originals while the copies are written.
        tensors = {name: value.detach().to("cpu", copy=True) for name, value in checkpoint.tensors.items()}
        copied = time.perf_counter() - begin
        self._pending = self._thread.submit(self._write, replace(checkpoint, tensors=tensors))
        # The steps wait for the copy, and share cores and disk with the thread.
        return max(self.least_seconds, (copied + took) / self.share)

    def finish(self) -> float:
        """Wait for the checkpoint that is being written, and return the seconds that it took."""
        pending, self._pending = self._pending, None
        return pending.result() if pending else 0.0

    def close(self) -> None:
        """Wait for the thread; an error of its last checkpoint is lost, `finish` raises it."""
        self._thread.shutdown()

    def _write(self, checkpoint: Checkpoint) -> float:
        begin = time.perf_counter()
        save_checkpoint(self.path, checkpoint)
        return time.perf_counter() - begin
