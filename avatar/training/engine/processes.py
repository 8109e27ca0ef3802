"""Data-parallel training: micro-batches shared among processes, and gradients summed over them.

Messages are JSON and the bytes of tensors. Pickles would hold a checkpoint in memory twice more, and could run code.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from smplxpp.core.errors import InputError, ToldInputError
from smplxpp.core.files.json_file import parse_json

S = TypeVar("S")
T = TypeVar("T")
_About = tuple[list[int], str, bool]
"""Shape and type of a tensor in a message, and whether it lies on the CPU."""
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

        Returns:
            The results in the items' order; of several processes, with all tensors on the CPU.

        Raises:
            InputError: fewer items than processes.
            TypeError: a result of a kind that `run_on_rank0` does not send either.
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
        parts = self._gather(results)
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

    def run_on_rank0(self, work: Callable[[], T], *, kinds: Sequence[type] = ()) -> T:
        """Run `work` on the first process and return its result on all; its error is raised on all.

        Args:
            work: returns None, numbers, texts, paths, tensors, or lists, tuples and mappings of them. Tensors arrive on
                the CPU where they were there, else on each process's own device.
            kinds: dataclasses that the result may consist of, too.

        Raises:
            TypeError: a result of another kind.
        """
        if self.world_size == 1:
            return work()
        # The result or the error of the first process, as JSON and tensors.
        result, error, text, tensors = None, None, b"", list[Tensor]()
        if self.first:
            try:
                result = work()
                text = json.dumps({"result": _packed(result, kinds, tensors)}).encode()
            except Exception as caught:  # noqa: BLE001  raised again below, after the others know
                error, tensors = caught, []
                text = json.dumps({"error": _error_fields(caught, self.rank)}).encode()
        answer = parse_json(self._broadcast_bytes(text), subject="message of the first process")
        if error is not None:
            raise error
        if "error" in answer:
            raise ToldInputError(answer["error"][0], **answer["error"][1])
        # Tensors follow one by one, so that no process holds all of them twice.
        if not self.first:
            return _unpacked(answer["result"], kinds, self._receive)
        for one in tensors:
            if one.numel():
                dist.broadcast(_flat_bytes(one, self.device), src=0)
        return result  # type: ignore[return-value]

    def run_on_all(self, work: Callable[[], T], same: Callable[[T], Any]) -> T:
        """Run `work` on every process at once and return each one's own result; an error of any is raised on all.

        Args:
            work: reads files that all processes see; the first one alone warns.
            same: returns what must be equal on all, as JSON values.

        Raises:
            InputError: results that are not equal.
        """
        if self.world_size == 1:
            return work()
        error: Exception | None = None
        with warnings.catch_warnings():
            if not self.first:
                warnings.simplefilter("ignore")
            try:
                result = work()
                answer = {"same": same(result)}
            except Exception as caught:  # noqa: BLE001  raised again below, after the others know
                error, answer = caught, {"error": _error_fields(caught, self.rank)}
        # The first process raises its own error as it is, or another's in its words, and tells it for all.
        answers = self._gather(answer)
        if error is not None and (self.first or not isinstance(error, InputError)):
            raise error
        kind = InputError if self.first else ToldInputError
        for answer in answers:
            if "error" in answer:
                raise kind(answer["error"][0], **answer["error"][1]) from error
        others = [str(rank) for rank, answer in enumerate(answers) if answer != answers[0]]
        if others:
            raise kind(
                "inputs of the processes",
                expected="the same files on every machine",
                received=f"other contents on rank {', '.join(others)} than on rank 0",
                remedy="let all machines read one copy of capture and run",
            )
        return result

    def _gather(self, value: Any) -> list[Any]:
        """Return the values of all processes, by rank, with their tensors on the CPU."""
        # One message a process: length of the JSON, the JSON, and its tensors' bytes.
        tensors: list[Tensor] = []
        text = json.dumps(_packed(value, (), tensors)).encode()
        begin = _bytes_of(len(text).to_bytes(8, "little") + text).to(self.device)
        own = torch.cat([begin, *(_flat_bytes(one, self.device) for one in tensors)])
        sizes = [torch.zeros(1, dtype=torch.int64, device=self.device) for _ in range(self.world_size)]
        dist.all_gather(sizes, torch.tensor([len(own)], device=self.device))
        # Collectives take equal sizes, so that shorter messages are filled up.
        longest = max(int(size) for size in sizes)
        all_of_them = [own.new_empty(longest) for _ in range(self.world_size)]
        dist.all_gather(all_of_them, torch.nn.functional.pad(own, (0, longest - len(own))))
        values = []
        for message in (one.cpu() for one in all_of_them):
            at = 8 + int.from_bytes(message[:8].numpy().tobytes(), "little")
            reader = _Reader(message, at)
            values.append(
                _unpacked(parse_json(message[8:at].numpy().tobytes(), subject="message of a process"), (), reader.next)
            )
        return values

    def _broadcast_bytes(self, own: bytes) -> bytes:
        """Return the bytes of the first process; the others' are ignored."""
        size = torch.tensor([len(own)], dtype=torch.int64, device=self.device)
        dist.broadcast(size, src=0)
        box = _bytes_of(own).to(self.device) if self.first else size.new_empty(int(size), dtype=torch.uint8)
        dist.broadcast(box, src=0)
        return box.cpu().numpy().tobytes()

    def _receive(self, about: _About) -> Tensor:
        """Return the first process's next tensor, which has this shape, type and place."""
        received = torch.empty(about[0], dtype=getattr(torch, about[1]), device=self.device)
        if received.numel():
            dist.broadcast(received.reshape(-1).view(torch.uint8), src=0)
        return received.cpu() if about[2] else received


@contextmanager
def join_processes(device: str = "cpu") -> Iterator[Distributed]:
    """Join the processes that `train --processes` or `torchrun` started; yield this one alone where neither did.

    Args:
        device: "cpu" (messages by gloo) or "cuda" (NCCL; each process takes the GPU of its LOCAL_RANK).

    Raises:
        InputError: an environment that torchrun does not make, or more processes than GPUs.
        ChildProcessError: another process ended, and this one waited for its message.
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
                remedy="start fewer (--processes, or torchrun --nproc-per-node)",
            )
        torch.cuda.set_device(local)
        device = f"cuda:{local}"
    # NCCL between GPUs, gloo between CPUs.
    dist.init_process_group(
        "nccl" if device.startswith("cuda") else "gloo", rank=rank, world_size=size, timeout=TIMEOUT
    )
    try:
        yield Distributed(rank, size, device)
    except RuntimeError as error:
        # gloo notices at once that another process is gone; its words name a socket.
        if "by peer" not in str(error):
            raise
        raise ChildProcessError(
            f"process {rank} of {size}: expected messages of the others, received none: one has ended. The same "
            "command continues from the last checkpoint"
        ) from error
    finally:
        dist.destroy_process_group()


def torchrun_variables() -> tuple[dist.Store, dict[str, str]]:
    """Return the variables that let processes of this machine find each other, and their store, to be kept till then.

    The store is the caller's, as torchrun's is its agent's, so that no port has to be found before it is used.
    """
    store = dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    return store, {
        **{"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port)},
        "TORCHELASTIC_USE_AGENT_STORE": "True",
    }


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


def _error_fields(error: Exception, rank: int) -> tuple[str, dict[str, str]]:
    """Return an error of a process as the arguments of an `InputError`."""
    if isinstance(error, InputError):
        return error.subject, {"expected": error.expected, "received": error.received, "remedy": error.remedy}
    who = f"process {rank}" if rank else "the first process"
    return who, {"expected": "to go on", "received": f"{type(error).__name__}: {error}"}


class _Reader:
    """Reads tensors from a message, one after the other, beginning at byte `at`."""

    def __init__(self, message: Tensor, at: int) -> None:
        self.message, self.at = message, at

    def next(self, about: _About) -> Tensor:
        dtype = getattr(torch, about[1])
        begin, self.at = self.at, self.at + math.prod(about[0]) * dtype.itemsize
        # A copy, because a view of another type has to begin at a multiple of its size.
        return self.message[begin : self.at].clone().view(dtype).reshape(about[0])


def _bytes_of(data: bytes) -> Tensor:
    return torch.frombuffer(bytearray(data), dtype=torch.uint8)


def _flat_bytes(tensor: Tensor, device: str) -> Tensor:
    """Return the bytes of a tensor, since not every collective has every type."""
    return tensor.detach().to(device).contiguous().reshape(-1).view(torch.uint8)


def _packed(value: Any, kinds: Sequence[type], tensors: list[Tensor]) -> Any:
    """Return a value as JSON whose tensors are appended to a list."""

    def inner(one: Any) -> Any:
        return _packed(one, kinds, tensors)

    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list):
        return [inner(one) for one in value]
    if isinstance(value, tuple):
        return {"tuple": [inner(one) for one in value]}
    if isinstance(value, Mapping):
        return {"mapping": [[inner(key), inner(one)] for key, one in value.items()]}
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, Tensor):
        tensors.append(value)
        return {"tensor": [list(value.shape), str(value.dtype).removeprefix("torch."), value.device.type == "cpu"]}
    if type(value) in kinds:
        own = {field.name: inner(getattr(value, field.name)) for field in fields(value)}
        return {"kind": kinds.index(type(value)), "fields": own}
    raise TypeError(f"processes do not send each other a {type(value).__name__}")


def _unpacked(packed: Any, kinds: Sequence[type], tensor: Callable[[_About], Tensor]) -> Any:
    """Return the value that `_packed` made JSON of; `tensor` gives its tensors in their order."""

    def inner(one: Any) -> Any:
        return _unpacked(one, kinds, tensor)

    if isinstance(packed, list):
        return [inner(one) for one in packed]
    if not isinstance(packed, dict):
        return packed
    if "kind" in packed:
        return kinds[packed["kind"]](**{name: inner(one) for name, one in packed["fields"].items()})
    if "tuple" in packed:
        return tuple(inner(one) for one in packed["tuple"])
    if "mapping" in packed:
        return {inner(key): inner(one) for key, one in packed["mapping"]}
    return Path(packed["path"]) if "path" in packed else tensor(packed["tensor"])
