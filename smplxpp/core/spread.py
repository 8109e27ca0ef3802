"""Pick an evenly spaced subset of a sequence of frames, views or names; split the frames of a take into chunks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from smplxpp.core.errors import InputError, require_at_least

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


@dataclass(frozen=True)
class Chunk:
    """Frames that one process computes.

    Attributes:
        frames: all of them, ascending.
        kept: those whose results are joined, each in one chunk alone.
    """

    frames: tuple[int, ...]
    kept: tuple[int, ...]

    @property
    def name(self) -> str:
        """Return a name that sorts as the frames do."""
        return f"{self.kept[0]:06d}_{self.kept[-1]:06d}"


def split_frames(frames: Sequence[int], size: int, *, overlap: int = 0) -> tuple[Chunk, ...]:
    """Split frames into chunks of about equal length.

    Args:
        frames: numbers, ascending, not necessarily without gaps.
        size: most frames that a chunk keeps.
        overlap: frames beside its own that it computes on each side.

    Raises:
        InputError: no frames, or a size below 1.

    Example:
        >>> [(chunk.frames, chunk.kept) for chunk in split_frames(range(5), 3, overlap=1)]
        [((0, 1, 2, 3), (0, 1, 2)), ((2, 3, 4), (3, 4))]
    """
    numbers = sorted(set(frames))
    require_at_least("frames of a chunk", size, 1)
    if not numbers:
        raise InputError("frames to split", expected="at least one", received="none")
    # Equal lengths, because a short last chunk has little that holds its first frames.
    count = -(-len(numbers) // size)
    parts = np.array_split(np.arange(len(numbers)), count)
    return tuple(
        Chunk(
            tuple(numbers[max(0, int(part[0]) - overlap) : int(part[-1]) + 1 + overlap]),
            tuple(numbers[int(part[0]) : int(part[-1]) + 1]),
        )
        for part in parts
    )
