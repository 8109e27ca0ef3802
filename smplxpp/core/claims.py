"""Tell whether the process that claimed a file still works: by its number here, by the age of its file elsewhere."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


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
