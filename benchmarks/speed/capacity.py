"""Foretell what a fleet of captures takes, compare that with what a batch took, and time the runner itself.

python -m benchmarks capacity --subjects 300 --frames 6000 --cameras 48 --preset gpu --gpus 8 --cores 256 --disk-tb 60
python -m benchmarks capacity --check RUNS ... [--rates-out rates.json]
python -m benchmarks capacity --runner [--jobs 1000] [--kills 10]

The first tells storage, reading and writing, hours by step, and where it breaks first. The second prints what each
step and each stage of a training was foretold to take of each finished subject of batches, as the rates say and with
factors learned from all *others*, and writes the rates with the factors that all show; `--rates FILE` and
`smplxpp batch --dry-run --rates FILE` take such a file. The third times empty jobs, one worker against two, and random
kills; its commands are stand-ins that answer at once or sleep, so that what is measured is the runner's own.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from benchmarks.support.results import store_results
from pipelines.batch.amounts import Facts
from pipelines.batch.driver import Progress, begin_batch, drive, take_batch
from pipelines.batch.executors import LocalExecutor
from pipelines.batch.jobs import read_jobs
from pipelines.batch.plan import Cost, Spent, breaks_first, cost_of, demands, learned, spent_in
from pipelines.batch.rates import Rates, Site, read_rates
from pipelines.batch.records import JobRecord, read_batch, read_job, records_of
from pipelines.batch.run_job import Resources
from smplxpp.core.files.atomic import atomic_write_text

STEPS = ("convert", "check", "reconstruct", "register", "build", "train", "evaluate", "export", "web")


def main() -> int:
    """Foretell, compare or time; store the figures where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=300)
    parser.add_argument("--frames", type=int, default=6000)
    parser.add_argument("--cameras", type=int, default=48)
    parser.add_argument("--size", type=int, nargs=2, default=(1500, 2000), help="pixels that are trained on")
    parser.add_argument("--source-mb", type=float, default=4.0, help="of an image as recorded, with its mask")
    parser.add_argument("--held-out", type=int, nargs=2, default=(4, 600), help="cameras and frames that are measured")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=list(STEPS))
    parser.add_argument("--preset", default="gpu")
    parser.add_argument("--rates", type=Path, help="JSON with rates, and the site under `site`")
    parser.add_argument("--check", type=Path, nargs="+", metavar="RUNS", help="batches whose subjects are compared")
    parser.add_argument("--rates-out", type=Path, help="with --check: where the rates of this site are written")
    parser.add_argument("--runner", action="store_true", help="time the runner itself")
    parser.add_argument("--jobs", type=int, default=1000, help="with --runner: empty jobs of one step")
    parser.add_argument("--kills", type=int, default=10, help="with --runner: random kills of running commands")
    parser.add_argument("--store", action="store_true", help="keep the figures in benchmarks/results")
    for name, value in asdict(Site()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value))
    args = parser.parse_args()
    rates, site = read_rates(args.rates)
    site = replace(site, **{name: value for name in asdict(site) if (value := getattr(args, name)) is not None})
    if args.check is not None:
        spent = [one for runs in args.check for one in spent_in(runs, rates)]
        if args.rates_out is not None:
            own = asdict(learned(rates, spent))
            atomic_write_text(args.rates_out, json.dumps({**own, "site": asdict(site)}, indent=1) + "\n")
        name, found = "capacity_check", compare(spent, rates)
    elif args.runner:
        name, found = "batch", time_runner(args.jobs, args.kills)
    else:
        cameras, frames = args.held_out
        megapixels = args.size[0] * args.size[1] / 1e6
        facts = Facts(args.frames, args.cameras, megapixels, args.source_mb, cameras, frames)
        name, found = "capacity", foretell(args.subjects, facts, rates, site, args.steps, args.preset)
    print(json.dumps(found, indent=1))
    if args.store:
        store_results(name, f"python -m benchmarks capacity {' '.join(sys.argv[1:])}".replace(" --store", ""), found)
    return 0


def foretell(subjects: int, facts: Facts, rates: Rates, site: Site, steps: list[str], preset: str) -> dict[str, Any]:
    """Return costs by step, hours by resource, and what breaks first."""
    one = {step: cost_of(step, facts, rates, options={"preset": preset}, gpu=site.gpus > 0) for step in steps}
    low = replace(rates, convert_mb_mp=(rates.convert_mb_mp[0], rates.convert_mb_mp[0]))
    least = cost_of("convert", facts, low).written_gb
    whole = {step: cost.times(subjects) for step, cost in one.items()}
    return {
        "subjects": subjects,
        "images of a subject": facts.images,
        "rows": {step: {name: rounded(value) for name, value in asdict(cost).items()} for step, cost in one.items()},
        "all subjects": {name: rounded(value) for name, value in asdict(sum(whole.values(), Cost())).items()},
        "TB converted, least and most": [
            rounded(1e-3 * subjects * least),
            rounded(1e-3 * whole["convert"].written_gb) if "convert" in whole else None,
        ],
        "hours that each resource is busy": {k: rounded(v) for k, v in demands(whole.values(), site).items()},
        "breaks first": breaks_first(whole, site),
        "site": asdict(site),
    }


def compare(spent: Sequence[Spent], rates: Rates) -> dict[str, Any]:
    """Return foretold over measured seconds of each subject, leaving its own out of what is learned, and print them."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for one in spent:
        factors = learned(rates, [other for other in spent if other.subject != one.subject]).factors
        factor = factors.get(one.what, 1.0) / rates.factors.get(one.what, 1.0)
        row = {"subject": one.subject, "what": one.what, "measured_s": rounded(one.measured)}
        for name, scale in (("foretold", 1.0), ("learned", factor)):
            row |= {f"{name}_s": rounded(scale * one.foretold), f"{name}_unsure_s": rounded(scale * one.unsure)}
            row[f"{name}_ratio"] = rounded(scale * one.foretold / one.measured) if one.measured else None
        rows.setdefault(one.subject, []).append(row)
    # The stages of a training beside what the whole of it was foretold.
    whole = []
    for subject, own in rows.items():
        steps = [row for row in own if row["what"] in STEPS]
        stages = [row for row in own if row["what"] not in STEPS]
        for what, chosen in (("stages of the training", stages), ("all steps", steps)):
            measured = sum(row["measured_s"] for row in chosen)
            row = {"subject": subject, "what": what, "measured_s": rounded(measured)}
            for name in ("foretold", "learned"):
                sums = [sum(one[f"{name}{end}"] for one in chosen) for end in ("_s", "_unsure_s")]
                row |= {f"{name}_s": rounded(sums[0]), f"{name}_unsure_s": rounded(sums[1])}
                row[f"{name}_ratio"] = rounded(sums[0] / measured) if measured else None
            whole.append(row)
    for row in [*(row for own in rows.values() for row in own), *whole]:
        words = (
            f"{row[f'{n}_s']:.1f} ± {row[f'{n}_unsure_s']:.1f} s ({row[f'{n}_ratio']})" for n in ("foretold", "learned")
        )
        print(
            f"{row['subject']:12} {row['what']:24} measured {row['measured_s']:.1f} s, foretold "
            + ", learned ".join(words)
        )
    return {"rows": [row for own in rows.values() for row in own], "subjects": whole}


def time_runner(jobs: int, kills: int) -> dict[str, Any]:
    """Return the runner's own time and memory on stand-ins of the commands."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    figures: dict[str, Any] = {"empty": _row(*_run(jobs, ("check",), workers=2))}
    after = resource.getrusage(resource.RUSAGE_SELF)
    own = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    figures["empty"] |= {"driver_cpu_ms_a_job": 1e3 * own / jobs, "driver_peak_mb": 1.024e-3 * after.ru_maxrss}
    for workers in (1, 2):
        done = _run(12, ("check", "build", "export"), workers=workers, seconds=1.0)
        figures[f"sleeping, {workers} workers"] = _row(*done)
    figures["kills"] = _killed(kills)
    figures["interpreter_cpu_seconds"] = _interpreter()
    return figures


def _run(
    count: int,
    steps: tuple[str, ...],
    *,
    workers: int,
    seconds: float = 0.0,
    report: Callable[[Path, Progress], None] = lambda runs, progress: None,
) -> tuple[float, list[JobRecord]]:
    """Run empty jobs; the seconds that it took, and their records."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "capture").mkdir()
        lines = [f"  - {{subject: s{k:04}, capture: capture}}" for k in range(count)]
        path = folder / "jobs.yaml"
        path.write_text("\n".join(["out: runs", f"defaults: {{steps: [{', '.join(steps)}]}}", "jobs:", *lines]))
        file = read_jobs(path)
        program = ("/bin/sh", "-c", f"sleep {seconds}; echo '{{\"finished\": true}}'", "sh")
        resources = Resources(program=program, folder=place, max_retries=100)
        with take_batch(file.out) as held:
            begin_batch(file, path)
            begin = time.perf_counter()
            executor = LocalExecutor(file.out, resources, workers=workers, gpus=[], cores=2)
            drive(file.out, file.jobs, executor, held=held, report=lambda progress: report(file.out, progress))
            took = time.perf_counter() - begin
        return took, records_of(file.out, read_batch(file.out))


def _row(took: float, records: list[JobRecord]) -> dict[str, Any]:
    """Return the time a job beside the sum of its commands."""
    commands = sum(step.seconds for record in records for step in record.steps)
    states = [record.state for record in records]
    return {
        "jobs": len(records),
        "done": states.count("done"),
        "seconds": took,
        "commands_seconds": commands,
        "ms_a_job": 1e3 * took / len(records),
    }


def _killed(kills: int) -> dict[str, Any]:
    """Return what random kills of running commands cost."""
    chance, ended = random.Random(0), list[bool]()

    def kill(runs: Path, progress: Progress) -> None:
        found = [read_job(runs, subject) for subject in progress.running]
        at_work = [s.pid for record in found if record for s in record.steps if s.state == "running" and s.pid]
        if at_work and len(ended) < kills:
            try:
                os.killpg(chance.choice(at_work), signal.SIGKILL)
                ended.append(True)
            except ProcessLookupError:
                pass

    took, records = _run(8, ("check", "build", "export"), workers=2, seconds=2.0, report=kill)
    attempts = sum(step.attempts for record in records for step in record.steps)
    return {**_row(took, records), "kills": len(ended), "attempts": attempts, "steps": 3 * len(records)}


def _interpreter() -> float:
    """Return the CPU seconds of a command that does nothing: Python's start and our imports."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "pipelines.cli", "--version"], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def rounded(value: float) -> float:
    """Return a number with three digits."""
    return float(f"{value:.3g}")


if __name__ == "__main__":
    raise SystemExit(main())
