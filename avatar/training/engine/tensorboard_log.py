"""The numbers of metrics.jsonl as TensorBoard's events, for those who look at curves there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from smplxpp.core.errors import MissingExtraError


class TensorboardLog:
    """Writes entries of a metrics log as scalars `kind/name`, and those of mappings as `kind/name/inner`.

    Args:
        folder: for TensorBoard's files.
        redone: first iteration whose entries come (again); TensorBoard hides what it has from there on.

    Raises:
        MissingExtraError: tensorboard is not installed.
    """

    def __init__(self, folder: Path, *, redone: int) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise MissingExtraError("tensorboard", extra="tensorboard", purpose="the log for TensorBoard") from None
        self._writer = SummaryWriter(str(folder), purge_step=redone)

    def add(self, entry: Mapping[str, Any]) -> None:
        """Add an entry with `kind`, `iteration` and numbers; all else in it is left out."""
        for tag, value in _numbers(entry["kind"], entry):
            if tag != f"{entry['kind']}/iteration":
                self._writer.add_scalar(tag, value, entry["iteration"])
        self._writer.flush()

    def close(self) -> None:
        """No more entries."""
        self._writer.close()


def _numbers(path: str, values: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _numbers(f"{path}/{name}", value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{path}/{name}", value
