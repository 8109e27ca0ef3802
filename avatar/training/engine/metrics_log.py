"""metrics.jsonl: one JSON object a line, appended as training goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smplxpp.core.atomic import atomic_write_text
from smplxpp.core.json_values import jsonable


def append_metrics(path: str | Path, entry: Mapping[str, Any]) -> None:
    """Add a line; numbers that are not finite become null."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(jsonable(entry)) + "\n")


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """All entries; a last line that a kill cut short is left out."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    entries = []
    for line in lines:
        try:
            entries.append(json.loads(line))
        except ValueError:
            break
    return entries


def truncate_metrics(path: str | Path, iteration: int) -> None:
    """Drop the entries after `iteration`: those steps are done again from the checkpoint."""
    kept = [entry for entry in read_metrics(path) if entry["iteration"] <= iteration]
    atomic_write_text(path, "".join(json.dumps(entry) + "\n" for entry in kept))
