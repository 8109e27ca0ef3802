"""Values that a run's files hold, where another version, another program or a hand may have written them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipelines.runs.stage import MANIFEST, StageRecord
from smplxpp.core.errors import InputError

_REMEDY = "it was written by another version or is damaged: delete its folder and give the command that makes it again"
# What values of another kind than expected raise where they are taken apart and formatted.
_OF_ANOTHER_KIND = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)


@contextmanager
def values_of(file: Path | StageRecord) -> Iterator[None]:
    """Around the lines that take a file's values apart, or those of a stage's manifest: what they raise names the file.

    Only values that were read are to be taken apart there: a mistake of ours in those lines would be told as one of the
    file. What a stage has recorded in this very call was never read, and its errors stay what they are.

    Raises:
        InputError: missing entries, entries of another kind, or what the lines themselves refuse.
    """
    if isinstance(file, StageRecord) and file.ran:
        yield
        return
    path = file.folder / MANIFEST if isinstance(file, StageRecord) else file
    try:
        yield
    except InputError as error:
        if isinstance(file, StageRecord) or str(path) in str(error):  # files of the stage name themselves
            raise
        raise InputError(
            f"file {path}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy or _REMEDY,
        ) from error
    except _OF_ANOTHER_KIND as error:
        received = f"{type(error).__name__}: {error}"[:200]
        raise InputError(
            f"file {path}", expected="the entries that this version writes", received=received, remedy=_REMEDY
        ) from error
