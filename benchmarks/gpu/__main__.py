"""Run what needs CUDA in as many minutes as given, the most important parts first.

    python -m benchmarks gpu --minutes 15

Each part runs in a process of its own with its share of the time that is left; what the others need less is shared
out again. benchmarks/results/gpu_parts.json is written after each part. A part that fails, crashes or takes too long is
stored with its error and what it had measured, and the next one begins. Without a CUDA device it says what it would run
and ends with 2; with --dry-run every part runs on the CPU at toy size, and results go to the work folder.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from benchmarks.gpu.parts import PARTS, ROOT, TEMPLATE, Job
from benchmarks.support.results import RESULTS, store_results

SHARES = {
    "mapping": 3.0,
    "template": 0.7,
    "steps": 5.0,
    "student": 1.3,
    "gpu": 3.0,
    "loader": 0.4,
    "nccl": 0.5,
    "demo": 2.5,
    "cpu": 4.0,
}
"""Shares of the time by part; gsplat compiles its kernels in the first."""
LEAST = {"mapping": 150.0, "template": 60.0}
"""Seconds that a part has whatever its share, because all others need it."""
NEEDS_TEMPLATE = ("steps", "student", "gpu", "demo", "cpu")
FAILED, NO_DEVICE = 1, 2
LAST_WORDS = 2_000
"""Characters of a part's output that are kept when it fails."""


@dataclass(frozen=True)
class GpuBenchmark:
    """Run what needs a GPU and store what came out."""

    minutes: float = 15.0
    """Minutes for all parts together."""
    capture: Path = ROOT / "data" / "fixtures" / "person"
    """Folder of the capture to train on."""
    run_folder: Path | None = None
    """Run with a template of its person; by default one is built."""
    work: Path | None = None
    """Folder for runs and logs; by default a temporary one, which stays."""
    parts: tuple[str, ...] = ()
    """Names of the parts to run; by default all."""
    dry_run: bool = False
    """Every part on the CPU at toy size: to see that the parts work before a GPU is paid for."""

    def run(self) -> int:
        """Run the parts; 0 if all came to their end, 1 if not, 2 without a GPU or for a name that is no part's."""
        chosen = [name for name in PARTS if not self.parts or name in self.parts]
        if unknown := set(self.parts) - set(PARTS):
            print(f"no such part: {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
            return NO_DEVICE
        if not self.dry_run and not torch.cuda.is_available():
            print("no CUDA device that torch can use. With one, these would run, one after the other:")
            for name in chosen:
                print(f"  {name:<11} {_seconds(name, chosen, 60 * self.minutes):4.0f} s  {PARTS[name].__doc__}")
            print("--dry-run runs them on the CPU at toy size.")
            return NO_DEVICE
        work = (self.work or Path(tempfile.mkdtemp(prefix="smplxpp_gpu_"))).resolve()
        work.mkdir(parents=True, exist_ok=True)
        run = (self.run_folder or work / "run").resolve()
        end = time.monotonic() + 60.0 * self.minutes
        figures: dict[str, Any] = {"minutes": self.minutes, "device": _device(self.dry_run), "parts": {}}
        for k, name in enumerate(chosen):
            # Time that earlier parts left over goes to the later ones.
            seconds = _seconds(name, chosen[k:], end - time.monotonic())
            job = Job(work, run, self.capture.resolve(), seconds, "cpu" if self.dry_run else "cuda")
            figures["parts"][name] = result = run_part(name, job)
            path = self._store(figures, work)
            print(
                f"{name:<11} {result['state']:<8} {result['seconds']:6.1f} s  {result.get('error', '')[:200]}",
                flush=True,
            )
        print(f"stored {path}\nlogs {work}")
        return 0 if all(result["state"] == "done" for result in figures["parts"].values()) else FAILED

    def _store(self, figures: dict[str, Any], work: Path) -> Path:
        parts = f" --parts {' '.join(self.parts)}" if self.parts else ""
        command = f"python -m benchmarks gpu --minutes {self.minutes:g}{parts}" + self.dry_run * " --dry-run"
        # The work folder may be all that comes back of a machine that is lent.
        kept = store_results("gpu_parts", command, figures, folder=work)
        return kept if self.dry_run else store_results("gpu_parts", command, figures, folder=RESULTS)


def run_part(name: str, job: Job) -> dict[str, Any]:
    """Run one part in its own process: how it ended ("done", "failed", "stopped"), what it found, its last words."""
    begin = time.monotonic()
    if name in NEEDS_TEMPLATE and not (job.run / TEMPLATE).is_file():
        return {"state": "failed", "seconds": 0.0, "error": "there is no template: the part before made none"}
    if job.seconds <= 0:
        return {"state": "stopped", "seconds": 0.0, "error": "no time left"}
    found, log, order = (job.work / f"{name}.{suffix}" for suffix in ("json", "log", "job"))
    # The part writes its findings as it goes, so that those of a killed part are kept; old ones must not be read.
    found.unlink(missing_ok=True)
    job.save(order)
    with log.open("w") as words:
        # A process group of its own can be ended with its children, and frees all memory of the GPU.
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.gpu.parts", name, str(order)],
            cwd=ROOT,
            stdout=words,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code: int | None = process.wait(job.seconds)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            _end(process)
    result: dict[str, Any] = {"state": "done" if code == 0 else "failed", "seconds": time.monotonic() - begin}
    if code is None:
        result |= {"state": "stopped", "error": f"took longer than its {job.seconds:.0f} s"}
    elif code:
        text = log.read_text(errors="replace").strip()
        result |= {"error": text.rsplit("\n", 1)[-1] or f"exit status {code}", "log": text[-LAST_WORDS:]}
    if found.is_file():
        result["found"] = json.loads(found.read_text())
    return result


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a part's process and what it started, if it still runs."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _seconds(name: str, left: list[str], seconds: float) -> float:
    """The share of a part in the seconds that it and those after it have."""
    share = seconds * SHARES[name] / sum(SHARES[each] for each in left)
    return min(seconds, max(share, LEAST.get(name, 0.0)))


def _device(dry_run: bool) -> dict[str, object]:
    """The GPU and what drives it."""
    if dry_run:
        return {"name": "CPU, toy sizes", "torch": torch.__version__}
    about = torch.cuda.get_device_properties(0)
    return {
        "name": about.name,
        "memory_gib": round(about.total_memory / 2**30, 1),
        "count": torch.cuda.device_count(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
    }


if __name__ == "__main__":
    sys.exit(tyro.cli(GpuBenchmark, prog="python -m benchmarks gpu").run())
