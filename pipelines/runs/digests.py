"""What a stage was made from, as digests: files and the versions of libraries."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import regular_file

GEOMETRY = ("numpy", "scipy", "libigl", "fast-simplification")
TRAINING = (*GEOMETRY, "torch")
"""Libraries whose versions decide what a stage of either kind gives."""


def sha256_file(path: str | Path) -> str:
    """Hex SHA-256 of a regular file's content.

    Raises:
        InputError: missing, no regular file, or one that cannot be read.
    """
    try:
        with open(regular_file(path), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"file {path}", expected="a readable file", received=error.strerror or str(error)) from None


def versions(libraries: Iterable[str] = GEOMETRY) -> dict[str, str]:
    """Versions of Python and of the libraries that compute the result."""
    return {"python": platform.python_version(), **{name: version(name) for name in libraries}}
