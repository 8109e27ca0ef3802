"""Nested dictionaries of arrays in one npz file, without pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def save_arrays(path: Path, groups: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write `{group: {name: array}}` as `group/name`."""
    flat: dict[str, Any] = {f"{g}/{name}": array for g, arrays in groups.items() for name, array in arrays.items()}
    np.savez(path, **flat)


def load_arrays(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Read what `save_arrays` wrote, groups in their order."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    with np.load(path, allow_pickle=False) as data:
        for key in data.files:
            group, name = key.split("/", 1)
            groups.setdefault(group, {})[name] = data[key]
    return groups
