"""Data-parallel training: micro-batches shared among processes, and gradients summed over them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from smplxpp.core.errors import InputError

S = TypeVar("S")
T = TypeVar("T")
TIMEOUT = timedelta(hours=4)
"""Timeout of messages between processes; it must exceed the evaluations of the first one."""


@dataclass(frozen=True)
class Distributed:
    """One of the processes that train together; by default the only one, for which every method is trivial.

    All processes call each method at the same time, with equal arguments except where documented.

    Attributes:
        rank: of this process, from 0. Process 0 alone evaluates and writes.
        world_size: number of processes.
        device: of this process's tensors.
    """

    rank: int = 0
    world_size: int = 1
    device: str = "cpu"

    @property
    def first(self) -> bool:
        """Whether this is process 0, which evaluates and writes."""
        return self.rank == 0

    def share_out(self, items: Sequence[S], work: Callable[[S], T | None]) -> list[T | None]:
        """Return `work(item)` of every item, on every process; process `k mod world_size` works on item k.

        A process stops after an item for which `work` returns None; its later items are None as well.

        Raises:
            InputError: fewer items than processes.
        """
        if len(items) < self.world_size:
            raise InputError(
                "micro-batches of a step",
                expected=f"at least one for each of {self.world_size} processes",
                received=str(len(items)),
                remedy="start fewer processes, or take larger batches",
            )
        # Own items, then everybody's results in the items' order.
        results: list[T | None] = [None] * len(items)
        for k in range(self.rank, len(items), self.world_size):
            results[k] = work(items[k])
            if results[k] is None:
                break
        if self.world_size == 1:
            return results
        parts: list[Any] = [None] * self.world_size
        dist.all_gather_object(parts, results)
        return [parts[k % self.world_size][k] for k in range(len(items))]

    def sum_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Replace every gradient by the sum over the processes, bit-identical on each, with one message.

        Processes without a gradient of a parameter add nothing; a parameter without a gradient on all keeps none.
        """
        if self.world_size == 1:
            return
        # One flat tensor: flags of existing gradients, then all gradients.
        pieces = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        given = torch.tensor([float(p.grad is not None) for p in parameters], device=parameters[0].device)
        flat = torch.cat([given, *(piece.reshape(-1) for piece in pieces)])
        dist.all_reduce(flat)
        given, *sums = flat.split([len(parameters), *(p.numel() for p in parameters)])
        for parameter, summed, count in zip(parameters, sums, given.tolist(), strict=True):
            if count:
                if parameter.grad is None:
                    parameter.grad = torch.empty_like(parameter)
                parameter.grad.copy_(summed.view(parameter.shape))

    def run_on_rank0(self, work: Callable[[], T]) -> T:
        """Run `work` on the first process and return its result on all; its error is raised on all."""
        if self.world_size == 1:
            return work()
        # The result or the error of the first process, broadcast to all.
        box: list[Any] = [None, None]
        error = None
        if self.first:
            try:
                box[0] = work()
            except Exception as caught:  # noqa: BLE001  raised again below, after the others know
                error = caught
                box[1] = _error_fields(caught)
        dist.broadcast_object_list(box, src=0, device=torch.device(self.device))
        if error is not None:
            raise error
        if box[1] is not None:
            raise InputError(box[1][0], **box[1][1])
        return box[0]


@contextmanager
def join_processes(device: str = "cpu") -> Iterator[Distributed]:
    """Join the processes that `torchrun` started for the block; without torchrun yield this one alone.

    Args:
        device: "cpu" (messages by gloo) or "cuda" (NCCL; each process takes the GPU of its LOCAL_RANK).

    Raises:
        InputError: an environment that torchrun does not make, or more processes than GPUs.
    """
    if "WORLD_SIZE" not in os.environ:
        yield Distributed(device=device)
        return
    # Rank, GPU and number of processes from torchrun's environment.
    rank, local, size = (_number(name) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"))
    if device == "cuda":
        if local >= torch.cuda.device_count():
            raise InputError(
                "processes",
                expected=f"at most one for each of {torch.cuda.device_count()} GPUs",
                received=f"local rank {local}",
                remedy="start fewer with torchrun --nproc-per-node",
            )
        torch.cuda.set_device(local)
        device = f"cuda:{local}"
    # NCCL between GPUs, gloo between CPUs.
    dist.init_process_group(
        "nccl" if device.startswith("cuda") else "gloo", rank=rank, world_size=size, timeout=TIMEOUT
    )
    try:
        yield Distributed(rank, size, device)
    finally:
        dist.destroy_process_group()


def _number(name: str) -> int:
    """Read a number of torchrun's environment variables."""
    text = os.environ.get(name, "")
    if not text.isdigit():
        raise InputError(
            f"environment variable {name}",
            expected="a number, as torchrun sets it",
            received=repr(text),
            remedy="start with torchrun --nproc-per-node N, or without WORLD_SIZE for one process",
        )
    return int(text)


def _error_fields(error: Exception) -> tuple[str, dict[str, str]]:
    """Return an error as the arguments of an `InputError`."""
    if isinstance(error, InputError):
        return error.subject, {"expected": error.expected, "received": error.received, "remedy": error.remedy}
    return "the first process", {"expected": "to go on", "received": f"{type(error).__name__}: {error}"}
