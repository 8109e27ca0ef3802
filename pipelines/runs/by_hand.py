"""Files that a user's hand made and that lie in a run beside its stages: every stage reads them, none writes them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pipelines.runs.lock import own_run_folder
from pipelines.runs.places import same_place
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.paths import read_bytes

_MOST_BYTES = 1 << 30


def take_file(run: Path, name: str, source: Path | None, *, read: Callable[[Path], object]) -> None:
    """Copy a file that the user names to its place in a run, over what lies there; None leaves that as it is.

    Args:
        name: of `pipelines.runs.layout`.
        read: its reader, which refuses a file that is none before anything is replaced.

    Raises:
        InputError: a file that cannot be read, or another command at work in the run.
    """
    if source is None or same_place(source, run / name):
        return
    read(source)
    with own_run_folder(run, (Path(name).stem,)):
        atomic_write_bytes(run / name, read_bytes(source, subject="file", most=_MOST_BYTES))
