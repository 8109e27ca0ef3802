"""Check paths and names that come from users and files before anything is opened, and claims of processes on files."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from smplxpp.core.errors import InputError

# Characters of a name in a path that the library makes, and of a foreign path in a message.
_MAX_NAME = 200


def regular_file(path: str | Path, *, subject: str = "file", remedy: str = "") -> Path:
    """Return the path if a regular file (or a link to one) is there; pipes and devices never end.

    Raises:
        InputError: no file, a folder, a pipe, a socket or a device, or an impossible path.
    """
    path = Path(path)
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(f"{subject} {path}", expected="an existing file", received="none", remedy=remedy) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL or half a character in the name
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(
            f"{subject} {str(path)[:_MAX_NAME]!r}", expected="a readable file", received=f"{reason}", remedy=remedy
        ) from None
    if not stat.S_ISREG(mode):
        received = "a folder" if stat.S_ISDIR(mode) else "a pipe, a socket or a device"
        raise InputError(f"{subject} {path}", expected="a regular file", received=received, remedy=remedy)
    return path


def read_bytes(path: str | Path, *, subject: str = "file", most: int = 1 << 33, remedy: str = "") -> bytes:
    """Return the bytes of a regular file of at most `most` bytes.

    Raises:
        InputError: missing, no regular file, unreadable or larger.
    """
    path = regular_file(path, subject=subject, remedy=remedy)
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= most else b""
    except OSError as error:
        received = error.strerror or str(error)
        raise InputError(f"{subject} {path}", expected="a readable file", received=received, remedy=remedy) from None
    if size > most:
        raise InputError(f"{subject} {path}", expected=f"at most {most} bytes", received=f"{size}", remedy=remedy)
    return data


def read_text(path: str | Path, *, subject: str = "file", most: int = 1 << 30, remedy: str = "") -> str:
    """Return the text of a regular file of at most `most` bytes, UTF-8 with or without a byte order mark.

    Raises:
        InputError: what `read_bytes` refuses, and bytes that are no text.
    """
    data = read_bytes(path, subject=subject, most=most, remedy=remedy)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{subject} {path}", expected="text in UTF-8", received=str(error), remedy=remedy) from None


def path_inside(root: str | Path, name: str, *, base: str | Path | None = None, subject: str = "file name") -> Path:
    """Return the path that a file inside `root` names, relative to `base` (a folder of `root`; None: `root` itself).

    The name alone is checked, with either kind of slash; links that the user put in the folder may lead elsewhere.

    Raises:
        InputError: an absolute name, a name that leaves `root`, or an impossible name.
    """
    # Normalise without following links: ".." is resolved in the text alone.
    text = name.replace("\\", "/")
    joined = Path(os.path.normpath(Path(root if base is None else base) / text))
    inside = joined.is_relative_to(os.path.normpath(root))
    # File systems take 255 bytes for the name of a file or folder.
    too_long = any(len(part.encode(errors="replace")) > 255 for part in joined.parts)
    # Absolute paths of Unix ("/...") and of Windows ("C:/...") are refused.
    if not text or "\0" in text or text.startswith("/") or text[1:3] == ":/" or not inside or too_long:
        raise InputError(
            subject,
            expected=f"a path inside of {root}",
            received=repr(name[:_MAX_NAME]),
            remedy="copy or link the file into the folder and name it from there",
        )
    return joined


def check_name(name: str, *, subject: str) -> str:
    """Return the name if it can be part of a file name, as names of cameras and people are.

    Raises:
        InputError: an empty or too long name, or one with a slash or unprintable characters.
    """
    usable = name.isprintable() and name.strip() and len(name) <= _MAX_NAME and not set(name) & {"/", "\\"}
    if not usable or name in (".", ".."):
        raise InputError(
            subject,
            expected=f"a name of 1 to {_MAX_NAME} printable characters without slashes",
            received=repr(name[:_MAX_NAME]),
        )
    return name


def absolute(path: Path) -> Path:
    """Return the absolute path without `..`; links stay as they are."""
    return Path(os.path.abspath(path))


def same_place(one: Path, other: Path) -> bool:
    """Return whether two paths are the same as they are written, or lead to the same file or folder."""
    return absolute(one) == absolute(other) or one.resolve() == other.resolve()


def lies_in(path: Path, folder: Path) -> bool:
    """Return whether a path lies in a folder as it is written, or where its links lead."""
    return absolute(path).is_relative_to(absolute(folder)) or path.resolve().is_relative_to(folder.resolve())


def ascii_numbers(text: str) -> str:
    """Return a text whose numbers are written in ASCII's digits alone, so that `float` and numpy may read them.

    Raises:
        ValueError: what Python takes for numbers beside: `1_0`, digits of other alphabets.

    Example:
        >>> float(ascii_numbers("-1.5e2"))
        -150.0
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"no number: {text[:40]!r}")
    return text


def age_of(path: Path) -> float:
    """Return the seconds since a file was changed, by the clock of the machine that keeps the disk.

    Raises:
        OSError: there is no such file, or nothing can be written beside it.
    """
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".clock.") as clock:
        return os.stat(clock.name).st_mtime - os.stat(path).st_mtime


def process_runs(pid: int) -> bool:
    """Return whether this machine has a process of this number; on Windows, which cannot be asked so, always."""
    if pid <= 0:
        return False
    if os.name == "nt":  # signal 0 is Ctrl-C there
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True
