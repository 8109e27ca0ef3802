"""Guard the folder of a run: its lock, what may not be written into, and the files that users put there."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipelines.runs.layout import (
    ABLATION,
    ALL_STAGES,
    BUILD_FILE,
    OLD_STAGE_NAMES,
    RECONSTRUCT_FILE,
    REGISTER_FILE,
)
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes, try_lock
from smplxpp.core.files.paths import absolute, read_bytes, same_place

RUNS_OF_A_CAPTURE = "runs"
"""The one folder of a capture in which runs may lie, because no reader of captures looks there."""
LOCK_NAME = ".lock"
_RECORDS = (LOCK_NAME, BUILD_FILE, REGISTER_FILE, RECONSTRUCT_FILE)


def keep_out_of_capture(out: Path, capture: Path | None, *, subject: str = "--out") -> None:
    """Refuse an output folder that would mix its files with those of a capture.

    Refused are the capture's own folder, every folder in it but those in its folder `runs`, and a folder of which the
    capture is a stage, or lies in one.

    Args:
        out: output folder, which need not exist.
        capture: folder of the capture that is read, or None.
        subject: the option that names `out`.

    Raises:
        InputError: the folder is refused.
    """
    if capture is None:
        return
    # Compare the paths as given and with links resolved: a link may lead into the capture, or out of it.
    for folder, root in ((absolute(out), absolute(capture)), (out.resolve(), capture.resolve())):
        if folder.is_relative_to(root):
            inside = folder.relative_to(root).parts
            mixed = len(inside) < 2 or inside[0] != RUNS_OF_A_CAPTURE
            received = "the capture's own folder" if not inside else f"{out}, a folder in it"
        else:
            stage = root.relative_to(folder).parts[0] if root.is_relative_to(folder) else ""
            mixed = stage in (*ALL_STAGES, ABLATION)
            received = f"{out}, in which the capture takes the place of {stage}"
        if mixed:
            raise InputError(
                subject,
                expected=f"a folder apart from the capture {capture}",
                received=received,
                remedy=f"choose another folder, as {capture / RUNS_OF_A_CAPTURE / 'NAME'} or runs/{root.name}",
            )


def refuse_old_run(folder: Path) -> None:
    """Refuse a run folder whose stages have the names that earlier versions gave them.

    Its stages would be made again under their new names beside the old ones, and half of the run would be read from
    either. `pipelines.cli` calls this for every folder that a command is given, and `own_run_folder` for every run
    that Python code writes.

    Raises:
        InputError: the folder holds a stage under an old name.
    """
    for old, new in OLD_STAGE_NAMES.items():
        if (folder / old / "manifest.json").is_file():
            raise InputError(
                f"run folder {folder}",
                expected=f"stages named as this version names them ({new})",
                received=f"{old}, which an earlier version wrote",
                remedy="build the run again in a new folder",
            )


def _at_once(path: str, flags: int) -> int:
    """Open a file without blocking, so that a pipe without a reader is an error."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)


@contextmanager
def own_run_folder(run: Path, names: Sequence[str]) -> Iterator[None]:
    """Create and lock the folder `run`, and remove the temporary `.NAME.*` that a killed build left.

    The lock is the operating system's, so that it ends with the process in every case.

    Args:
        names: stems of the stages and files that the caller writes.

    Raises:
        InputError: the folder cannot be written, another build works in it, or its stages have old names.
    """
    refuse_old_run(run)
    new = not run.exists()
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock = open(run / LOCK_NAME, "w", opener=_at_once)
    except OSError as error:
        raise InputError(
            f"run folder {run}",
            expected="a folder that can be written",
            received=error.strerror or str(error),
            remedy="choose another folder",
        ) from None
    # The lock does not wait: a second build in the same run is refused at once.
    with lock:
        if not try_lock(lock.fileno()):
            raise InputError(
                f"run folder {run}",
                expected="no other build in it",
                received="a running one",
                remedy="wait for its end, or choose another folder",
            )
        for name in names:
            # Temporary files of a killed build are incomplete, and under the lock no other process can be writing them.
            for left in run.glob(f".{name}.*"):
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        try:
            yield
        except BaseException:
            if new:
                _remove_if_empty(run)
            raise


def _remove_if_empty(run: Path) -> None:
    """Remove the folder of a first build that failed, unless it holds more than records of what was asked for.

    A finished stage, the state of one that was stopped, a picture that tells why and the user's own files are kept.
    """
    left = list(run.iterdir())
    if all(path.name in _RECORDS for path in left):
        for path in left:
            path.unlink()
        run.rmdir()


def take_file(run: Path, name: str, source: Path | None, *, read: Callable[[Path], object]) -> None:
    """Copy a user's file to its place in a run and replace an older one; None leaves the older one.

    Landmarks and label corrections are such files: stages read them, and none writes them.

    Args:
        run: folder of the run.
        name: file name of `pipelines.runs.layout`.
        source: the user's file.
        read: reader of the file, which refuses a wrong file before anything is replaced.

    Raises:
        InputError: a file that cannot be read, or another command at work in the run.
    """
    if source is None or same_place(source, run / name):
        return
    read(source)
    with own_run_folder(run, (Path(name).stem,)):
        atomic_write_bytes(run / name, read_bytes(source, subject="file", most=1 << 30))
