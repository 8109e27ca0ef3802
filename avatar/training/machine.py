"""What a training takes of the machine: its random numbers and its memory."""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Random numbers of the CPU within the block follow from `seed`; those after it are as if it had not been."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def peak_memory(device: str = "cpu") -> dict[str, int]:
    """Bytes that this process has held at most: of the machine's memory, and of the GPU's where it computes there."""
    unit = 1 if sys.platform == "darwin" else 1024
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    if not device.startswith("cuda"):
        return {"host": host}
    return {"host": host, "device": torch.cuda.max_memory_allocated(device)}
