"""Pick an evenly spaced subset of a sequence of frames, views or names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def spread(values: Sequence[T], count: int) -> list[T]:
    """Pick at most `count` of the values, evenly from the first to the last, both among them."""
    if not len(values):
        return []
    chosen = np.unique(np.linspace(0, len(values) - 1, min(count, len(values))).round().astype(int))
    return [values[k] for k in chosen]


def spread_inside(values: Sequence[T], count: int) -> list[T]:
    """Pick at most `count` of the values, each from the middle of its share of the sequence."""
    count = min(count, len(values))
    return [values[int((k + 0.5) * len(values) / count)] for k in range(count)]
