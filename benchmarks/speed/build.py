"""Time the build of a template from a scan: seconds by stage, peak memory, checks.

    python -m benchmarks build [--captures DIR] [--repeats 3]

Each build is a process of its own, so that start-up and memory count as a user meets them.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.support.results import FIXTURE, store_results


@dataclass(frozen=True)
class BuildBenchmark:
    """Time `smplxpp build` on the fixture and on every capture of a folder."""

    captures: Path | None = None
    """Folder whose subfolders are captures."""
    repeats: int = 3
    """Builds of each; the median is reported."""

    def run(self) -> None:
        """Build, print and store."""
        folders = [FIXTURE]
        if self.captures is not None:
            folders += sorted(p for p in self.captures.iterdir() if (p / "scans").is_dir())
        figures = {folder.name: _measure(folder, self.repeats) for folder in folders}
        for name, f in figures.items():
            stages = "  ".join(f"{stage} {seconds:.2f}" for stage, seconds in f["stage_seconds"].items())
            print(f"{name}: {f['wall_seconds']:.1f} s, {f['peak_gib']:.2f} GiB, {f['status']}\n  {stages}")
        path = store_results("build", "python -m benchmarks build --captures DIR", figures)
        print(f"stored {path.name}")


def _measure(capture: Path, repeats: int) -> dict:
    runs = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            command = [sys.executable, "-m", "pipelines.cli", "build", str(run), "--capture", str(capture)]
            begin = time.perf_counter()
            # wait4 gives this child's own peak memory; output goes nowhere.
            null = os.open(os.devnull, os.O_WRONLY)
            actions = [(os.POSIX_SPAWN_DUP2, null, 1), (os.POSIX_SPAWN_DUP2, null, 2)]
            child = os.posix_spawn(sys.executable, [*command, "--no-report"], os.environ, file_actions=actions)
            _, status, usage = os.wait4(child, 0)
            os.close(null)
            seconds = time.perf_counter() - begin
            if status:
                raise SystemExit(f"the build of {capture.name} ended with status {status}: run it by hand")
            metrics = json.loads((run / "metrics.json").read_text())
            runs.append((seconds, usage.ru_maxrss / 2**20, metrics))
    runs.sort(key=lambda r: r[0])
    middle = runs[len(runs) // 2][2]
    statuses = [check["status"] for check in middle["checks"]]
    return {
        "wall_seconds": statistics.median(r[0] for r in runs),
        "wall_seconds_all": [round(r[0], 2) for r in runs],
        "peak_gib": max(r[1] for r in runs),
        "stage_seconds": middle["seconds"],
        "status": {status: statuses.count(status) for status in ("pass", "warn", "fail")},
        "checks": {f"{c['stage']}: {c['name']}": c["value"] for c in middle["checks"]},
    }


if __name__ == "__main__":
    tyro.cli(BuildBenchmark, prog="python -m benchmarks build").run()
