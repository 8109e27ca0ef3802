"""Manifests whose numbers another program could have written."""

from __future__ import annotations

import copy
import random
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from pipelines.report import KeyNumber, Section
from pipelines.report.builder import readable, readable_numbers
from pipelines.runs.stage import StageRecord
from smplxpp.core.errors import GeometryWarning

_FOREIGN: tuple[Any, ...] = (None, "<b>", [], {}, [[1]], {"a": "b"}, True, -1, 1e300, 10**30, "../../../etc/passwd")


def _places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The keys that lead to every entry of nested objects and lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, one in inner:
        yield (*path, key)
        yield from _places(one, (*path, key))


def with_foreign_numbers(record: StageRecord, count: int, *, seed: int = 0) -> Iterator[StageRecord]:
    """The record as it would be read with one entry missing or of another kind: so many, of all parts alike."""
    draw = random.Random(seed)
    places: dict[Any, list[tuple[Any, ...]]] = {}
    for path in _places(record.manifest["numbers"]):
        places.setdefault(path[0], []).append(path)
    for _ in range(count):
        numbers = copy.deepcopy(record.manifest["numbers"])
        *above, last = draw.choice(places[draw.choice(list(places))])
        holder = numbers
        for key in above:
            holder = holder[key]
        if draw.random() < 0.25:
            del holder[last]
        else:
            holder[last] = draw.choice(_FOREIGN)
        yield replace(record, manifest={**record.manifest, "numbers": numbers}, ran=False)


def sections_of(
    records: Iterator[StageRecord],
    make: Callable[[StageRecord], Section],
    numbers: Callable[[StageRecord], tuple[KeyNumber, ...]],
) -> tuple[int, int]:
    """How many of the records have their section, and how many one that says that it cannot be read."""
    found = [0, 0]
    for record in records:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", GeometryWarning)
            section = readable(record, "A stage", lambda record=record: make(record))
            readable_numbers(record, lambda record=record: numbers(record))
        unread = section.title == "A stage" and "cannot be read" in section.text[0]
        assert bool(told) or not unread
        assert not unread or "manifest.json" in section.text[0] or record.folder.name in section.text[0]
        found[unread] += 1
    return found[0], found[1]
