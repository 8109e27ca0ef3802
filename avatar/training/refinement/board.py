"""Share the work of a refinement among any number of processes that see one folder.

A pass over the frames is a sum over chunks of frames. Whoever is free computes a chunk that is not begun and writes
its sums; when all are there, every process adds them in one order and takes the same step, to the same bits. No process
leads: one that is killed loses the chunk that it was at, and one that comes later continues where the others are.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_arrays, write_arrays
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.paths import age_of, process_runs, read_bytes

Arrays = Mapping[str, np.ndarray]
_T = TypeVar("_T")


class RefinementStoppedError(RuntimeError):
    """A refinement was asked to stop; the same call continues from its state."""


class OvertakenError(Exception):
    """Other processes have finished this pass and cleared it away; the state tells where they are."""


@dataclass(frozen=True, eq=False)
class Board:
    """Results of chunks by name in a folder, computed once by one of the processes that share it.

    Attributes:
        folder: that all processes see.
        stop: whether to end; asked between two chunks and while others are waited for.
    """

    folder: Path
    stop: Callable[[], bool] = lambda: False

    def gather(self, name: str, count: int, compute: Callable[[int], Arrays]) -> list[Arrays]:
        """Return the arrays of all chunks of a pass, computed here or by others.

        Args:
            name: of the pass.
            count: number of its chunks.
            compute: returns the arrays of a chunk; calls nothing that waits for others.

        Raises:
            RefinementStoppedError: `stop` returned True; what is computed stays.
            OvertakenError: the pass is over.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        pause = shortest = 0.01  # seconds; a chunk of a small capture takes a tenth of one
        files = [self.folder / f"{name}_{k:04d}.npz" for k in range(count)]
        while True:
            left = [k for k, file in enumerate(files) if not file.is_file()]
            if not left:
                break
            if (self.folder / f"{name}.over").is_file():
                raise OvertakenError
            begun = next((k for k in left if self._claim(files[k])), None)
            if begun is None:
                time.sleep(pause)
                pause = min(1.5 * pause, 0.2)
            else:
                pause = shortest
                try:
                    write_arrays(files[begun], compute(begun))
                finally:  # also after an error: the same process may continue
                    with suppress(OSError):
                        files[begun].with_suffix(".claim").unlink()
            if self.stop():
                raise RefinementStoppedError(f"stopped in pass {name}")
        try:
            return [read_arrays(file, subject="part of a refinement") for file in files]
        except InputError:
            if (self.folder / f"{name}.over").is_file():
                raise OvertakenError from None
            raise

    def end(self, name: str) -> None:
        """Clear a pass away whose result the state holds."""
        atomic_write_text(self.folder / f"{name}.over", "")
        for file in (*self.folder.glob(f"{name}_*.npz"), *self.folder.glob(f"{name}_*.claim")):
            with suppress(OSError):
                file.unlink()

    def first(self, name: str) -> bool:
        """Return whether this process is the first that asks for a name."""
        try:
            (self.folder / name).touch(exist_ok=False)
        except FileExistsError:
            return False
        return True

    def touch(self) -> None:
        """Say that this process works on what it has begun; frames of an hour need more than the time of a claim."""
        for claim in self.folder.glob("*.claim"):
            with suppress(OSError):
                if _who_of(claim) == self._who:
                    os.utime(claim)

    @property
    def _who(self) -> str:
        return f"{platform.node()} {os.getpid()}"

    def _claim(self, file: Path) -> bool:
        """Begin a chunk unless another process has begun it; one that is silent for ten minutes counts as lost."""
        lost_after = 600.0  # seconds
        claim = file.with_suffix(".claim")
        with suppress(FileNotFoundError):  # not begun, or over
            if age_of(claim) > lost_after or _is_dead(_who_of(claim)):
                claim.unlink()
        if not self.first(claim.name):
            return False
        claim.write_text(self._who, encoding="utf-8")
        return not file.is_file()


def _who_of(claim: Path) -> str:
    """Return who has begun a chunk; empty where that is over, or not yet written."""
    with suppress(InputError):
        return read_bytes(claim).decode(errors="replace")
    return ""


def _is_dead(who: str) -> bool:
    """Return whether a claim is of a process of this machine that has ended."""
    node, _, process = who.rpartition(" ")
    return node == platform.node() and process.isdigit() and not process_runs(int(process))


def in_threads(work: Callable[[int], _T], rows: Sequence[int], after: Callable[[], None]) -> Iterator[_T]:
    """Yield what `work` returns for each frame, in order; as many frames at a time as torch has threads.

    Pictures of a few hundred pixels keep several threads waiting for each other, so that each frame has one thread.

    Args:
        work: takes the row of a frame.
        rows: of the frames.
        after: called after each frame.
    """
    threads = torch.get_num_threads()
    results: Iterator[_T] = map(work, rows)
    pool = None
    if min(threads, len(rows)) > 1:
        pool = ThreadPoolExecutor(threads, "frame", initializer=torch.set_num_threads, initargs=(1,))
        results = pool.map(work, rows)
    try:
        for result in results:
            after()
            yield result
    finally:
        if pool is not None:
            pool.shutdown(cancel_futures=True)
            # A thread sets its own number, and that of threads that start later.
            torch.set_num_threads(threads)
