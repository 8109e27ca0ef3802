"""One mutated input after the other through a door: what became of each."""

from __future__ import annotations

import logging
import os
import resource
import shutil
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smplxpp.core.errors import InputError
from tests.fuzz.mutate import mutated

CLEAN, READ, FOREIGN, HANG, MEMORY, CRASH = "clean error", "read", "foreign exception", "hang", "over memory", "crash"
OUTCOMES = (READ, CLEAN, FOREIGN, CRASH, HANG, MEMORY)
# Far more than any input needs on a busy machine.
SECONDS = 60
# What an input may make the process allocate.
_MEMORY = 4 << 30


@dataclass(frozen=True)
class Door:
    """One way into the program.

    Attributes:
        name: what is read.
        make: writes valid files to a folder; returns what is to be opened, None for the folder.
        open: reads it as a user's command would, or raises `InputError`.
        files: patterns of the files that are mutated.
        refuses: it raises for damage; False where it says so in the log and goes on.
    """

    name: str
    make: Callable[[Path], object]
    open: Callable[[Path], object]
    files: tuple[str, ...] = ("**/*",)
    refuses: bool = True


@dataclass
class Findings:
    """How many inputs ended how, and one traceback for each kind of foreign exception."""

    counts: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)

    def add(self, outcome: str, what: str = "", text: str = "") -> None:
        """Count an outcome; the first of its kind is kept."""
        self.counts[outcome] += 1
        if what:
            self.examples.setdefault(what, text)


class TooLong(BaseException):
    """An input has taken longer than any may."""


def examine(
    door: Door, seeds: Iterable[int], folder: Path, begun: Callable[[int], None] = lambda seed: None
) -> Findings:
    """Read a mutated copy of the door's files for each seed.

    Args:
        door: what is read.
        seeds: one an input; the same seed makes the same input.
        folder: an empty folder to work in.
        begun: told each seed before it is tried, so that another process knows which one ended this one.
    """
    made = door.make(folder)
    root = made if isinstance(made, Path) else folder
    files = sorted({p for pattern in door.files for p in folder.glob(pattern) if p.is_file()})
    originals = {path: path.read_bytes() for path in files}
    door.open(root)  # the valid files are read, or nothing is tested
    findings = Findings()
    for seed in seeds:
        begun(seed)
        rng = np.random.default_rng(seed)
        path = files[int(rng.integers(len(files)))]
        _spoil(path, originals[path], rng)
        try:
            with _limited():
                door.open(root)
            findings.add(READ)
        except InputError:
            findings.add(CLEAN)
        except MemoryError:
            findings.add(MEMORY, "MemoryError", f"seed {seed}, {path.name}\n{traceback.format_exc()}")
        except TooLong:
            findings.add(HANG, "hang", f"seed {seed}, {path.name}\n{traceback.format_exc()}")
        except Exception as error:  # noqa: BLE001  what is looked for
            place = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}"
            findings.add(FOREIGN, what, f"seed {seed}, {path.name}\n{traceback.format_exc()}")
        finally:
            _remove(path)
            path.write_bytes(originals[path])
    return findings


def _spoil(path: Path, original: bytes, rng: np.random.Generator) -> None:
    kind = int(rng.integers(100))
    if kind > 3:
        path.write_bytes(mutated(path.name, original, rng))
        return
    path.unlink()
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        os.mkfifo(path)
    elif kind == 2:
        path.symlink_to("/dev/zero")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def _limited() -> Iterator[None]:
    """Bound the time and the memory of an input; leave out what is said in warnings and in the log."""

    def stop(number: int, frame: object) -> None:
        raise TooLong

    before, memory = signal.signal(signal.SIGALRM, stop), resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, memory[1]))
    signal.alarm(SECONDS)
    logging.disable()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        signal.alarm(0)
        logging.disable(logging.NOTSET)
        resource.setrlimit(resource.RLIMIT_AS, memory)
        signal.signal(signal.SIGALRM, before)
