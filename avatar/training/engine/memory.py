"""What a training holds of the machine's memory."""

from __future__ import annotations

import resource
import sys

import torch


def peak_memory(device: str = "cpu") -> dict[str, int]:
    """Bytes that this process has held at most: of the machine's memory, and of the GPU's where it computes there."""
    unit = 1 if sys.platform == "darwin" else 1024
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    if not device.startswith("cuda"):
        return {"host": host}
    return {"host": host, "device": torch.cuda.max_memory_allocated(device)}
