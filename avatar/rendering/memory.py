"""Large tensors from memory that was used before.

A picture of ten channels and three million pixels is 120 MB. The allocator asks the system for that anew each time, and
faulting its pages in costs more than a tenth of drawing it.
"""

from __future__ import annotations

import math
import threading

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

POOLED_BYTES = 4 << 20
"""Tensors smaller than this come from torch, which keeps small memory itself."""
IDLE_BYTES = 1 << 30
"""Idle memory beyond this is freed, what was idle longest first."""

_lock = threading.Lock()
_idle: list[np.ndarray] = []


def pooled_empty(*shape: int) -> Float32[Tensor, "*S"]:
    """Make a float32 tensor, not initialised; its memory goes back to the pool when nothing uses it any more."""
    count = math.prod(shape)
    if 4 * count < POOLED_BYTES:
        return torch.empty(shape)
    with _lock:
        place = next((i for i in reversed(range(len(_idle))) if len(_idle[i]) == count), None)
        array = None if place is None else _idle.pop(place)
        while array is None and _idle and 4 * count + _idle_bytes() > IDLE_BYTES:
            _idle.pop(0)
    lease = _Lease(np.empty(count, np.float32) if array is None else array)
    return torch.from_numpy(np.asarray(lease)).view(shape)


class _Lease:
    """Owner of an array that numpy and torch look into: they let go of it with the last tensor."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array
        self.__array_interface__ = array.__array_interface__

    def __del__(self) -> None:
        # The garbage collector may call this in the middle of `pooled_empty`: no lock, and nothing but an append.
        if self.array.nbytes + _idle_bytes() <= IDLE_BYTES:
            _idle.append(self.array)


def _idle_bytes() -> int:
    return sum(array.nbytes for array in list(_idle))
