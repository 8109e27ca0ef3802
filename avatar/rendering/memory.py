"""Pool the memory of large tensors, and limit that of the lists of Gaussians by tile.

A picture of ten channels and three million pixels is 120 MB. The allocator requests it from the system each time, and
faulting its pages in costs more than a tenth of drawing it.

An entry of the lists is a Gaussian in one tile of 16 x 16 pixels. A usual scene has about ten a Gaussian; many large
Gaussians have thousands each, and would fill any memory before the first pixel is drawn.
"""

from __future__ import annotations

import math
import os
import threading
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from smplxpp.core.errors import InputError

POOLED_BYTES = 4 << 20
"""Smallest pooled tensor, bytes. torch allocates smaller ones, because it reuses small memory itself."""
IDLE_BYTES = 1 << 30
"""Total idle memory, bytes; more is freed, the longest idle first."""

VARIABLE = "SMPLXPP_LIST_GIB"
"""Environment variable with the limit in GiB."""
_GIB = 1 << 30

_lock = threading.Lock()
_idle: list[np.ndarray] = []


def pooled_empty(*shape: int) -> Float32[Tensor, "*S"]:
    """Return an uninitialised float32 tensor whose memory returns to the pool when its last user is gone."""
    count = math.prod(shape)
    if 4 * count < POOLED_BYTES:
        return torch.empty(shape)
    # An array of the same length is reused, the latest first; otherwise the longest idle ones are freed to make room.
    with _lock:
        place = next((i for i in reversed(range(len(_idle))) if len(_idle[i]) == count), None)
        array = None if place is None else _idle.pop(place)
        while array is None and _idle and 4 * count + _idle_bytes() > IDLE_BYTES:
            _idle.pop(0)
    lease = _Lease(np.empty(count, np.float32) if array is None else array)
    return torch.from_numpy(np.asarray(lease)).view(shape)


class _Lease:
    """Owner of a pooled array, kept alive by numpy and torch until the last tensor on it is gone."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array
        self.__array_interface__ = array.__array_interface__

    def __del__(self) -> None:
        # The garbage collector may call this in the middle of `pooled_empty`: it takes no lock and only appends.
        if self.array.nbytes + _idle_bytes() <= IDLE_BYTES:
            _idle.append(self.array)


def _idle_bytes() -> int:
    return sum(array.nbytes for array in list(_idle))


@cache
def list_bytes() -> int:
    """Return the limit of the lists: from the environment, or a quarter of the free memory within 1/2 to 4 GiB.

    It is determined once, so that a training does not fail because another program takes memory.

    Raises:
        InputError: the environment variable is not a positive number.
    """
    # A share of the free memory by default, so that the picture, gradients and other programs keep theirs.
    given = os.environ.get(VARIABLE)
    if given is None:
        return max(_GIB // 2, min(4 * _GIB, _free_bytes() // 4))
    try:
        limit = float(given)
    except ValueError:
        limit = 0.0
    if not 0 < limit < 1 << 20:
        raise InputError(f"environment variable {VARIABLE}", expected="a positive number of GiB", received=repr(given))
    return int(limit * _GIB)


def too_many_entries(
    means2d: Float32[Tensor, "N 2"], radii: Float32[Tensor, "N 2"], size: tuple[int, int], most: int, entry: int
) -> InputError:
    """Return the error for a scene whose lists exceed `most` bytes, with the number of entries by its boxes.

    Args:
        means2d: projected centres, pixels.
        radii: half sides of their boxes, pixels; 0 where culled.
        size: width and height of the image, pixels.
        most: limit of the lists, bytes.
        entry: bytes of an entry.
    """
    # Tiles that the box of each visible Gaussian overlaps.
    seen = radii[:, 0] > 0
    sides = []
    # First and last tile of 16 pixels along each axis, clamped to the image; their product is the number of tiles.
    for axis in (0, 1):
        low, high = (means2d[seen, axis] + sign * radii[seen, axis] for sign in (-1, 1))
        first, last = (edge.double().clamp(0, size[axis] - 1).div(16).floor() for edge in (low, high))
        sides.append(last - first + 1)
    entries, count = int((sides[0] * sides[1]).sum()), int(seen.sum())
    return InputError(
        "Gaussians to rasterise",
        expected=f"lists of Gaussians by tile within {most / _GIB:.3g} GiB ({most // entry:,} entries)",
        received=(
            f"up to {entries:,} entries ({entries * entry / _GIB:.3g} GiB): {count:,} visible Gaussians that cover "
            f"{entries / max(count, 1):,.0f} tiles each of {size[0]} x {size[1]} pixels"
        ),
        remedy=f"make the Gaussians fewer or smaller, or the image; {VARIABLE}=GIB raises the limit",
    )


def _free_bytes() -> int:
    """Return the memory available to this process: the least of the system's and the control group's."""
    known = [16 * _GIB]  # enough for the largest limit
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                known.append(1024 * int(line.split()[1]))
    except OSError:
        pass  # not Linux
    try:
        known.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):
        pass  # no limit
    return min(known)
