"""The device of a training, and a fixed seed of its random numbers."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

import torch

from smplxpp.core.errors import InputError

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
            log.warning("there is a GPU, but gsplat is not installed: training on the CPU (smplxpp[cuda] has it)")
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
