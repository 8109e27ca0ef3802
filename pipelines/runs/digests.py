"""What a stage was made from, as digests: files, code, versions."""

from __future__ import annotations

import hashlib
import platform
from importlib import import_module
from pathlib import Path


def sha256_file(path: str | Path) -> str:
    """Hex SHA-256 of a file's content."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def versions() -> dict[str, str]:
    """Versions of what computes the result."""
    from importlib.metadata import version

    names = ("smplxpp", "numpy", "scipy", "libigl", "fast-simplification")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def code_digest(*packages: str) -> str:
    """Hex SHA-256 of the Python sources of installed packages: a change of code is a change of version."""
    digest = hashlib.sha256()
    for package in packages:
        root = Path(str(import_module(package).__file__)).parent
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{package}/{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()
