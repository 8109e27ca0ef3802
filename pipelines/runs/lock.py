"""The folder of a run belongs to one build at a time, and what a killed build left in it goes."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipelines.runs.places import refuse_old_run
from smplxpp.core.errors import InputError

LOCK_NAME = ".lock"


def _at_once(path: str, flags: int) -> int:
    """Open a file; a pipe that nobody reads is an error, not something to wait for."""
    return os.open(path, flags | os.O_NONBLOCK, 0o666)


@contextmanager
def own_run_folder(run: Path, names: Sequence[str]) -> Iterator[None]:
    """Make the folder `run`, keep other builds out, and remove the temporary `.NAME.*` that a killed build left.

    The lock is the operating system's: it ends with the process, however that ends.

    Args:
        names: stems of what a build writes: stages and files.

    Raises:
        InputError: the folder cannot be written, another build works in it, or its stages have old names.
    """
    refuse_old_run(run)
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock = open(run / LOCK_NAME, "w", opener=_at_once)
    except OSError as error:
        raise InputError(
            f"run folder {run}",
            expected="a folder that can be written",
            received=error.strerror or str(error),
            remedy="choose another with --out",
        ) from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"run folder {run}",
                expected="no other build in it",
                received="one under way",
                remedy="wait for its end, or choose another folder with --out",
            ) from None
        for name in names:
            for left in run.glob(f".{name}.*"):
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        yield
