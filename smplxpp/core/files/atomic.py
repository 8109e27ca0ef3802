"""Write files and folders atomically: the complete result appears, or nothing."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

try:
    import fcntl
except ModuleNotFoundError:  # Windows, where an open file cannot be moved: nothing is held there
    fcntl = None  # type: ignore[assignment]

WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors that only writing raises: no space, quota, file too large, read-only file system."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file beside `path`, and move it onto `path` when the block ends without an error.

    The temporary name keeps the suffix, for writers that choose a format by it. System errors name `path`. What a
    killed process left of the same file is removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _named(None, path):
        # In the folder of the target, because a rename is atomic only within one file system.
        _remove_left(path.parent, f".{path.stem}.", path.suffix)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    temporary = Path(name)
    # Held until the end, or until the process is killed: the next writer tells by it what is left over.
    held = _hold(handle)
    # mkstemp makes private files; give the result the permissions of any new file.
    mask = os.umask(0)
    os.umask(mask)
    temporary.chmod(0o666 & ~mask)
    try:
        with _named(temporary, path):
            yield temporary
            # Readers see either the old file or the whole new one.
            os.replace(temporary, path)
    finally:
        if held:
            os.close(handle)
        temporary.unlink(missing_ok=True)


def atomic_write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path` atomically, replacing what is there."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def atomic_write_text(path: str | Path, text: str) -> None:
    """Write `text` in UTF-8 to `path` atomically, replacing what is there."""
    atomic_write_bytes(path, text.encode())


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, and replace `path` by it when the block ends without an error.

    System errors name the file as it would be called inside `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _named(None, path):
        _remove_left(path.parent, f".{path.name}.", "")
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        handle = os.open(temporary, os.O_RDONLY) if fcntl else None
    held = handle is not None and _hold(handle)
    mask = os.umask(0)
    os.umask(mask)
    temporary.chmod(0o777 & ~mask)
    try:
        with _named(temporary, path):
            yield temporary
            # A folder cannot be renamed onto a full one: move the old one aside, then delete it.
            if path.exists():
                old = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.old."))
                os.replace(path, old / path.name)
                os.replace(temporary, path)
                shutil.rmtree(old)
            else:
                os.replace(temporary, path)
    finally:
        if held and handle is not None:
            os.close(handle)
        shutil.rmtree(temporary, ignore_errors=True)


def try_lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed; False: another process has it. Windows has no such locks: True.

    Raises:
        OSError: the file system has no locks.
    """
    try:
        if fcntl:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _hold(handle: int) -> bool:
    """Lock an open file or folder, if its file system can; where the system has no such locks, close it at once."""
    with suppress(OSError):
        try_lock(handle)
    if not fcntl:
        os.close(handle)
    return fcntl is not None


def _remove_left(folder: Path, prefix: str, suffix: str) -> None:
    """Remove temporary files and folders of these names that no process holds."""
    if not fcntl:  # who holds a file cannot be told
        return
    left = re.compile(re.escape(prefix) + r"[a-z0-9_]{8}" + re.escape(suffix))  # as `tempfile` names them
    for name in filter(left.fullmatch, _hidden_names(folder)):
        with suppress(OSError):  # another process was quicker
            handle = os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
            try:
                if try_lock(handle):
                    shutil.rmtree(folder / name) if stat.S_ISDIR(os.fstat(handle).st_mode) else os.unlink(folder / name)
            finally:
                os.close(handle)


@lru_cache(maxsize=64)  # because thousands of pictures are written to one folder
def _hidden_names(folder: Path) -> tuple[str, ...]:
    """Return the names in a folder that begin with a dot, as they were when this process came to it."""
    return tuple(name for name in os.listdir(folder) if name.startswith("."))


@contextmanager
def _named(temporary: Path | None, path: Path) -> Iterator[None]:
    """Make system errors name `path`, where they name the temporary file or, as on a full disk, no file.

    Args:
        temporary: file or folder that stands for `path` during the block; None: the block creates it.
    """
    try:
        yield
    except OSError as error:
        name = error.filename
        if temporary is None or (name is None and error.errno in WRITE_ERRORS):
            error.filename = str(path)
        elif isinstance(name, str | os.PathLike) and Path(name).is_relative_to(temporary):
            error.filename = str(path / Path(name).relative_to(temporary))
        raise
