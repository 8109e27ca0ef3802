"""What a stored result is called on the page docs/benchmarks.md, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.page_tables import tables_of


@dataclass(frozen=True)
class Part:
    """A stored result on the page.

    Attributes:
        name: of its file in `benchmarks/results`. title: its heading.
        conditions: what the figures rest on, for whatever the file does not hold.
        lines: makes the Markdown of its figures.
    """

    name: str
    title: str
    conditions: str
    lines: Callable[[Any], list[str]] = tables_of
