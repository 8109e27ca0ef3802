"""What the figures were measured on, and how results are stored."""

from __future__ import annotations

import datetime
import json
import os
import platform
from pathlib import Path

from pipelines.runs.code import versions
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_values import jsonable

RESULTS = Path(__file__).parent / "results"


def describe_machine() -> dict[str, object]:
    """Processor, cores, memory and versions."""
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
    """Write `<name>.json` into `benchmarks/results`, or another folder, with the command, the date and the machine."""
    content = {
        "command": command,
        "date": datetime.date.today().isoformat(),
        "machine": describe_machine(),
        "figures": jsonable(figures),
    }
    path = (folder or RESULTS) / f"{name}.json"
    atomic_write_text(path, json.dumps(content, indent=1) + "\n")
    return path
