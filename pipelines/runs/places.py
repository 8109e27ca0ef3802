"""Whether two names are of one file, links or not: captures may link to files that lie elsewhere."""

from __future__ import annotations

import os
from pathlib import Path


def same_place(one: Path, other: Path) -> bool:
    """Tell whether two paths are the same as they are written, or lead to the same file or folder."""
    return absolute(one) == absolute(other) or one.resolve() == other.resolve()


def lies_in(path: Path, folder: Path) -> bool:
    """Tell whether a path lies in a folder as it is written, or where its links lead."""
    return absolute(path).is_relative_to(absolute(folder)) or path.resolve().is_relative_to(folder.resolve())


def absolute(path: Path) -> Path:
    """The absolute path without `..`; links stay as they are."""
    return Path(os.path.abspath(path))
