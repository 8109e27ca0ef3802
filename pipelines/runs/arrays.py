"""Nested dictionaries of arrays in one npz file, without pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files.array_file import read_arrays

_REMEDY = "the stage's file is damaged: delete the stage's folder and give the command again"


def save_arrays(path: Path, groups: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write `{group: {name: array}}` as `group/name`."""
    flat: dict[str, Any] = {f"{g}/{name}": array for g, arrays in groups.items() for name, array in arrays.items()}
    np.savez(path, **flat)


def load_arrays(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Read what `save_arrays` wrote, groups in their order.

    Raises:
        InputError: missing, damaged or foreign file.
    """
    groups: dict[str, dict[str, np.ndarray]] = {}
    for key, array in read_arrays(path, subject="stage file", remedy=_REMEDY).items():
        group, slash, name = key.partition("/")
        if not slash:
            raise InputError(f"stage file {path}", expected="arrays in groups", received=key, remedy=_REMEDY)
        groups.setdefault(group, {})[name] = array
    return groups


def read_named(path: Path, *names: str) -> tuple[np.ndarray, ...]:
    """Read arrays of a stage's npz file by their names.

    Raises:
        InputError: missing, damaged or foreign file, or one without them.
    """
    arrays = read_arrays(path, subject="stage file", remedy=_REMEDY)
    return tuple(take(arrays, *names, path=path).values())


def take(arrays: Mapping[str, np.ndarray], *names: str, path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of these names.

    Raises:
        InputError: one is missing.
    """
    missing = [name for name in names if name not in arrays]
    if missing:
        raise InputError(
            f"stage file {path}", expected=f"the array {missing[0]}", received="a file without it", remedy=_REMEDY
        )
    return {name: arrays[name] for name in names}
