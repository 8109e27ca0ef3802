"""Logs of a training: metrics.jsonl, one JSON object a line, and the same numbers for TensorBoard."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from smplxpp.core.errors import InputError
from smplxpp.core.files import as_integer, as_object, as_text, atomic_write_text, jsonable, parse_json, read_bytes
from smplxpp.core.lazy import import_extra

log = logging.getLogger(__name__)


def append_metrics(path: str | Path, entry: Mapping[str, Any]) -> None:
    """Append a line to a log; numbers that are not finite become null."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(jsonable(entry)) + "\n")


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """Return all entries of a log: objects with a kind and an iteration.

    A last line that a kill cut short is skipped. Other lines that are no entries, and a file that is no log, are
    skipped with a warning.
    """
    if not Path(path).exists():
        return []
    # 1 GiB; the lines of a million steps have some hundred megabytes.
    most_bytes = 1 << 30
    try:
        lines = read_bytes(path, subject="log", most=most_bytes).split(b"\n")
    except InputError as error:
        log.warning("%s", error)
        return []
    # Parse line by line; only the last line may be incomplete without a warning.
    read = [_entry(line) for line in lines]
    foreign = [number for number, entry in enumerate(read[:-1], start=1) if entry is None and lines[number - 1].strip()]
    if foreign:
        log.warning(
            "%s: %d lines are no entries of a log and left out, the first is %d", path, len(foreign), foreign[0]
        )
    return [entry for entry in read if entry is not None]


def truncate_metrics(path: str | Path, iteration: int) -> None:
    """Drop the entries after `iteration`, whose steps are repeated from the checkpoint."""
    # The log may be ahead of the checkpoint, which is written less often.
    kept = [entry for entry in read_metrics(path) if entry["iteration"] <= iteration]
    atomic_write_text(path, "".join(json.dumps(entry) + "\n" for entry in kept))


def _entry(line: bytes) -> dict[str, Any] | None:
    """Return the entry in a line; None for anything else."""
    try:
        entry = as_object(parse_json(line, subject="line"), subject="line")
        as_text(entry.get("kind"), subject="kind")
        as_integer(entry.get("iteration"), subject="iteration", least=0)
    except InputError:
        return None
    return entry


class TensorboardLog:
    """Writes entries of a metrics log as scalars `kind/name`, and those of mappings as `kind/name/inner`.

    Args:
        folder: for TensorBoard's files.
        redone: first iteration whose entries are repeated; TensorBoard hides its older ones from there on.

    Raises:
        MissingExtraError: tensorboard is not installed.
    """

    def __init__(self, folder: Path, *, redone: int) -> None:
        # torch has the writer, which needs the package.
        import_extra("tensorboard", extra="tensorboard", purpose="the log for TensorBoard")
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=redone)

    def add(self, entry: Mapping[str, Any]) -> None:
        """Add the numbers of an entry with `kind` and `iteration`; other values are ignored."""
        for tag, value in _numbers(entry["kind"], entry):
            if tag != f"{entry['kind']}/iteration":
                self._writer.add_scalar(tag, value, entry["iteration"])
        self._writer.flush()

    def close(self) -> None:
        """Close the writer; no entries can be added after that."""
        self._writer.close()


def _numbers(path: str, values: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the numbers in nested mappings with their paths."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _numbers(f"{path}/{name}", value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{path}/{name}", value
