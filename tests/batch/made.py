"""Batches of made records, for what reads them: any number of subjects in every state."""

from __future__ import annotations

import json
import random
from pathlib import Path

STEPS = ("convert", "check", "build", "train", "evaluate", "export")
CONVENTIONS = {"images": "PSNR: over pixels where mask or opacity exceed 0.02.", "surface": "P2S: mean distance, mm."}
REFUSAL = {
    "subject": "scan",
    "expected": "one whole person",
    "received": "two heads <b>& a dog</b>",
    "remedy": "give --params",
}


def write_subject(runs: Path, name: str, state: str, at: int = len(STEPS), **figures: float) -> Path:
    """Write a subject whose first `at` steps are done and whose next one is in the state; figures are of a student."""
    folder = runs / name
    (folder / "run").mkdir(parents=True, exist_ok=True)
    steps = []
    for k, step in enumerate(STEPS):
        now = "done" if k < at else state if k == at else "waiting"
        entry = {"step": step, "command": [step], "state": now}
        if now != "waiting":
            entry |= {
                "seconds": 60.0,
                "cpu_seconds": 90.0,
                "peak_mb": 500.0 + k,
                "host": "node7",
                "log": f"logs/{step}",
            }
            entry |= {"gpu": "0,1" if step == "train" else "", "attempts": 1, "exit_status": 0}
        if now in ("failed", "refused"):
            entry |= {"error": REFUSAL, "exit_status": 2}
        steps.append(entry)
    record = {"subject": name, "capture": f"/data/{name}", "steps": steps, "state": state, "note": ""}
    (folder / "job.json").write_text(json.dumps(record))
    if at > 2:
        (folder / "run" / "report.html").write_text("report")
        write_manifest(folder / "run", "60_assemble", checks=[{"name": "stretch", "status": "pass", "value": 1.0}])
    if at > 4:
        numbers = {
            "models": {"fit": {"novel_view.psnr": 10.0}, "student": dict(figures)},
            "metric": "st-lpips",
            "conventions": CONVENTIONS,
            "inputs": {"parameters": "tracked", "labels": "estimated", "normals": "none"},
        }
        write_manifest(folder / "run", "95_evaluate", numbers=numbers)
    return folder


def write_manifest(run: Path, stage: str, **entries: object) -> None:
    """Write a stage's manifest with these entries."""
    (run / stage).mkdir(parents=True, exist_ok=True)
    (run / stage / "manifest.json").write_text(json.dumps({"schema": 2, **entries}))


def write_batch(runs: Path, count: int) -> Path:
    """Write a batch of so many subjects, most of them done, with figures drawn from a seed."""
    drawn = random.Random(0)
    runs.mkdir(parents=True, exist_ok=True)
    states = ["failed", "refused", "stopped", "running", "waiting", *["done"] * 15]
    jobs = []
    for number in range(count):
        state, name = states[number % len(states)], f"subject_{number:04d}"
        at = {"done": len(STEPS), "waiting": 0}.get(state, drawn.randrange(len(STEPS)))
        figures = {"novel_pose.psnr": drawn.gauss(20.0, 1.0), "novel_view.psnr": drawn.gauss(25.0, 1.0)}
        figures |= {"novel_pose.perceptual": 0.014, "surface.held_out.p2s": 9.0, "megabytes": 24.0}
        write_subject(runs, name, state, at, **figures)
        jobs.append({"subject": name, "capture": f"/data/{name}", "steps": list(STEPS)})
    jobs.append({"subject": "not_begun", "capture": "/data/not_begun", "steps": list(STEPS)})
    content = {"format": "smplxpp batch", "format_version": 1, "name": "made", "version": "0.2.0", "code_key": "ab"}
    content |= {"started": "2026-01-31T12:00:00Z", "job_file": "jobs.yaml", "jobs": jobs}
    (runs / "batch.json").write_text(json.dumps(content))
    return runs
