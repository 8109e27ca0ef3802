"""Where a training computes, and what its random numbers follow from."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

import torch

from smplxpp.core.errors import InputError

log = logging.getLogger(__name__)


def choose_device(name: str) -> str:
    """Return "cpu" or "cuda" for "auto", "cpu" or "cuda"; auto takes CUDA where it is and gsplat, which draws there.

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
    """Let random numbers of the CPU within the block follow from `seed`; those after it are as if it had not been."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
