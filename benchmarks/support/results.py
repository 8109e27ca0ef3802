"""Store measured figures with the command, the date and the machine, as JSON with one row a line.

    python -m benchmarks.support.results

writes all files of `benchmarks/results` in that layout again; their data stays equal.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
from pathlib import Path
from typing import Any

from pipelines.runs.code import versions
from smplxpp.core.files import atomic_write_text, jsonable

ROOT = Path(__file__).resolve().parents[2]
FIXTURE = ROOT / "data" / "fixtures" / "person"
RESULTS = ROOT / "benchmarks" / "results"


def describe_machine() -> dict[str, object]:
    """Return the processor, the number of cores, the memory and the versions of packages."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    model = next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor()
    )
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "memory_gib": round(memory / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": versions(),
    }


def store_results(name: str, command: str, figures: object, *, folder: Path | None = None) -> Path:
    """Write figures as `<name>.json`, with the command, the date and the machine, and return the path."""
    content = {
        "command": command,
        "date": datetime.date.today().isoformat(),
        "machine": describe_machine(),
        "figures": jsonable(figures),
    }
    path = (folder or RESULTS) / f"{name}.json"
    atomic_write_text(path, rows_json(content) + "\n")
    return path


def rows_json(value: Any, *, row: int = 1000) -> str:
    """Return JSON text of a value with one row a line, and top-level keys on lines of their own.

    Args:
        value: what `json.dumps` takes.
        row: number of characters above which a nested value is split into lines. Flat lists and mappings stay on one
            line, however long they are, except at the top.

    Returns:
        Text from which `json.loads` gives back an equal value.
    """
    return _lines(value, row, "")


def _lines(value: Any, row: int, indent: str) -> str:
    text = json.dumps(value)
    values = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    nested = any(isinstance(one, dict | list) and one for one in values)
    if not values or (indent and not (nested and len(text) > row)):
        return text
    names = [f"{json.dumps(name)}: " for name in value] if isinstance(value, dict) else [""] * len(values)
    deeper = indent + " "
    parts = [deeper + name + _lines(one, row, deeper) for name, one in zip(names, values, strict=True)]
    begin, end = "{}" if isinstance(value, dict) else "[]"
    return f"{begin}\n" + ",\n".join(parts) + f"\n{indent}{end}"


def main() -> None:
    """Write every stored file again and check that its data is equal."""
    for path in sorted(RESULTS.rglob("*.json")):
        value = json.loads(path.read_text())
        text = rows_json(value) + "\n"
        # NaN differs from itself: compare what a plain dump gives, which keeps the order of keys as well.
        assert json.dumps(json.loads(text)) == json.dumps(value), path
        atomic_write_text(path, text)


if __name__ == "__main__":
    main()
