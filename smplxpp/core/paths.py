"""Paths that come from users and from files: checked before anything is opened."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from smplxpp.core.errors import InputError

_LONGEST_NAME = 200


def regular_file(path: str | Path, *, subject: str = "file", remedy: str = "") -> Path:
    """The path, if a regular file (or a link to one) is there: a pipe or a device would be read without an end.

    Raises:
        InputError: nothing there, a folder, a pipe, a socket or a device, or no path at all.
    """
    path = Path(path)
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(f"{subject} {path}", expected="an existing file", received="none", remedy=remedy) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL or half a character in the name
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(
            f"{subject} {str(path)[:_LONGEST_NAME]!r}", expected="a readable file", received=f"{reason}", remedy=remedy
        ) from None
    if not stat.S_ISREG(mode):
        received = "a folder" if stat.S_ISDIR(mode) else "a pipe, a socket or a device"
        raise InputError(f"{subject} {path}", expected="a regular file", received=received, remedy=remedy)
    return path


def path_inside(root: str | Path, name: str, *, base: str | Path | None = None, subject: str = "file name") -> Path:
    """The file that a file of `root` names, relative to `base` (a folder of `root`; None: `root` itself).

    The name alone is judged, with either kind of slash: links that a user has laid in the folder may lead elsewhere.

    Raises:
        InputError: an absolute name, one that leaves `root`, or one that no file can have.
    """
    text = name.replace("\\", "/")
    joined = Path(os.path.normpath(Path(root if base is None else base) / text))
    inside = joined.is_relative_to(os.path.normpath(root))
    if not text or "\0" in text or text.startswith("/") or text[1:3] == ":/" or not inside:
        raise InputError(
            subject,
            expected=f"a path inside of {root}",
            received=repr(name[:_LONGEST_NAME]),
            remedy="copy or link the file into the folder and name it from there",
        )
    return joined


def check_name(name: str, *, subject: str) -> str:
    """The name, if it can be part of a file's name: names of cameras and people become names of files.

    Raises:
        InputError: empty, too long, with a slash, or with characters that are not printed.
    """
    usable = name.isprintable() and name.strip() and len(name) <= _LONGEST_NAME and not set(name) & {"/", "\\"}
    if not usable or name in (".", ".."):
        raise InputError(
            subject,
            expected=f"a name of 1 to {_LONGEST_NAME} printable characters without slashes",
            received=repr(name[:_LONGEST_NAME]),
        )
    return name
