"""Resources of a training: device and seed, memory and disk, and errors that explain when these run out."""

from __future__ import annotations

import ctypes
import errno
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]

import torch

from smplxpp.core.errors import InputError

NO_MEMORY = ("out of memory", "can't allocate memory", "not enough memory")
"""Texts in messages of CUDA's libraries and of CPU allocators, which have no exception class of their own."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Options of glibc's malloc.h: sizes in bytes from which freed memory returns to the system, and one that none reaches.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _NEVER = -1, -3, 1 << 30


def peak_memory(device: str = "cpu") -> dict[str, int]:
    """Return the peak memory of this process, bytes: of the machine (Windows does not tell), and of the GPU it uses."""
    unit = 1 if sys.platform == "darwin" else 1024
    found = {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit} if resource else {}
    if device.startswith("cuda"):
        found["device"] = torch.cuda.max_memory_allocated(device)
    return found


def keep_freed_memory() -> bool:
    """Have the allocator keep freed memory for the next step; return whether it can (only glibc's does).

    Steps of a training allocate the same tens of megabytes repeatedly. If they return to the system each time, they
    come back as thousands of empty pages, which costs a tenth of a step of the compensation on two cores. The setting
    holds for the whole process.
    """
    if not sys.platform.startswith("linux"):
        return False
    # Only glibc has mallopt with these options.
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
    # Memory: exceptions of Python and torch, or messages of allocators.
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
    # Disk: no space, quota, or file size.
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise InputError(
            f"disk of {folder}",
            expected="room for checkpoints and results",
            received=error.strerror or str(error),
            remedy="free some space and give the same command, which continues from the last checkpoint",
        ) from error


log = logging.getLogger(__name__)


def choose_device(name: str) -> str:
    """Return "cpu" or "cuda" for "auto", "cpu" or "cuda"; auto takes CUDA where a GPU and gsplat are available.

    Raises:
        InputError: CUDA where there is none.
    """
    if name == "auto":
        if not torch.cuda.is_available():
            return "cpu"
        if find_spec("gsplat") is None:
            log.warning(
                "there is a GPU, but gsplat is not installed: training on the CPU (install '.[cuda]' in the checkout)"
            )
            return "cpu"
        return "cuda"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("option device", expected="a CUDA device that torch can use", received="none")
    return name


@contextmanager
def fixed_seed(seed: int) -> Iterator[None]:
    """Seed the CPU's random numbers within the block, and restore their state after it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
