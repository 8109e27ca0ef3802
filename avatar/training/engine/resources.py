"""Memory and disk of the machine: their use by a training, and errors that explain when they run out."""

from __future__ import annotations

import ctypes
import errno
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from smplxpp.core.errors import InputError

NO_MEMORY = ("out of memory", "can't allocate memory", "not enough memory")
"""Texts in messages of CUDA's libraries and of CPU allocators, which have no exception class of their own."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Options of glibc's malloc.h: sizes in bytes from which freed memory returns to the system, and one that none reaches.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _NEVER = -1, -3, 1 << 30


def peak_memory(device: str = "cpu") -> dict[str, int]:
    """Return the peak memory of this process, bytes: of the machine, and of the GPU where it uses one."""
    unit = 1 if sys.platform == "darwin" else 1024
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    if not device.startswith("cuda"):
        return {"host": host}
    return {"host": host, "device": torch.cuda.max_memory_allocated(device)}


def keep_freed_memory() -> bool:
    """Have the allocator keep freed memory for the next step; return whether it can (only glibc's does).

    Steps of a training allocate the same tens of megabytes repeatedly. If they return to the system each time, they
    come back as thousands of empty pages, which costs a tenth of a step of the compensation on two cores. The setting
    holds for the whole process.
    """
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):
        return False
    return all(libc.mallopt(option, _NEVER) == 1 for option in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD))


@contextmanager
def explain_resource_errors(folder: Path) -> Iterator[None]:
    """Turn errors of memory and disk within the block into an `InputError`; all others pass.

    Args:
        folder: where checkpoints and results go.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        words = str(error)
        known = isinstance(error, MemoryError | torch.cuda.OutOfMemoryError)
        if not (known or any(part in words.lower() for part in NO_MEMORY)):
            raise
        raise InputError(
            "memory",
            expected="room for a step of the training",
            received=words.splitlines()[0] if words else type(error).__name__,
            remedy="end other programs and give the same command, which continues from the last checkpoint; or take a "
            "smaller preset, smaller images (--scale) or fewer Gaussians",
        ) from error
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise InputError(
            f"disk of {folder}",
            expected="room for checkpoints and results",
            received=error.strerror or str(error),
            remedy="free some space and give the same command, which continues from the last checkpoint",
        ) from error
