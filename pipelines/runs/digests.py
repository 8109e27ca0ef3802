"""What a stage was made from, as digests: files and the versions of libraries."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

GEOMETRY = ("numpy", "scipy", "libigl", "fast-simplification")
TRAINING = (*GEOMETRY, "torch")
"""Libraries whose versions decide what a stage of either kind gives."""


def sha256_file(path: str | Path) -> str:
    """Hex SHA-256 of a file's content."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions(libraries: Iterable[str] = GEOMETRY) -> dict[str, str]:
    """Versions of Python and of the libraries that compute the result."""
    return {"python": platform.python_version(), **{name: version(name) for name in libraries}}
