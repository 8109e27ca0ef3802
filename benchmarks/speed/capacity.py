"""Foretell what a fleet of captures takes: storage, reading and writing, hours by step, and where it breaks first.

python -m benchmarks capacity --subjects 300 --frames 6000 --cameras 48 --preset gpu --gpus 8 --cores 256 --disk-tb 60
python -m benchmarks capacity --check RUNS [--rates-out rates.json]

The second compares what the rates foretell with what the finished subjects of a batch took, and writes the rates with
the factors that they show; `--rates FILE` and `smplxpp batch --dry-run --rates FILE` take such a file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from benchmarks.support.results import store_results
from pipelines.batch.amounts import Facts, facts_of
from pipelines.batch.plan import (
    Cost,
    Rates,
    Site,
    breaks_first,
    cost_of,
    demands,
    learned,
    read_rates,
)
from pipelines.batch.records import read_batch, read_job
from smplxpp.core.files.atomic import atomic_write_text

STEPS = ("convert", "check", "reconstruct", "register", "build", "train", "evaluate", "export", "web")


def main() -> int:
    """Foretell, or compare; store what was foretold for the captures of the docs."""
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
    parser.add_argument("--check", type=Path, metavar="RUNS", help="a batch whose finished steps are compared")
    parser.add_argument("--rates-out", type=Path, help="with --check: where the rates of this site are written")
    parser.add_argument("--store", action="store_true", help="keep the figures in benchmarks/results")
    for name, value in asdict(Site()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value))
    args = parser.parse_args()
    rates, site = read_rates(args.rates)
    site = replace(site, **{name: value for name in asdict(site) if (value := getattr(args, name)) is not None})
    if args.check is not None:
        figures = compare(args.check, rates)
        if args.rates_out is not None:
            spent = {step: [(row["foretold_s"], row["measured_s"]) for row in rows] for step, rows in figures.items()}
            own = learned(rates, spent)
            atomic_write_text(args.rates_out, json.dumps({**asdict(own), "site": asdict(site)}, indent=1) + "\n")
        name, found = "capacity_check", {"steps": figures, "of the sums": of_sums(figures)}
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


def compare(runs: Path, rates: Rates) -> dict[str, list[dict[str, Any]]]:
    """Return foretold and measured core seconds of every step that is done, by step."""
    out: dict[str, list[dict[str, Any]]] = {}
    for job in read_batch(runs).jobs:
        record = read_job(runs, job["subject"])
        if record is None:
            continue
        facts = facts_of(Path(job["capture"]))
        for step in record.steps:
            # An attempt that was lost counts too: compare steps that needed one.
            if facts is None or step.state != "done" or step.attempts != 1:
                continue
            words = dict(zip(step.command, [*step.command[1:], ""], strict=True))
            options = {word[2:].replace("-", "_"): value for word, value in words.items() if word.startswith("--")}
            cost = cost_of(step.step, facts, rates, options=options, gpu=bool(step.gpu))
            foretold, measured = 3600.0 * cost.core_hours, step.cpu_seconds
            row = {"subject": record.subject, "foretold_s": rounded(foretold), "measured_s": rounded(measured)}
            out.setdefault(step.step, []).append({**row, "ratio": rounded(measured / max(foretold, 1e-9))})
    return out


def of_sums(rows: Mapping[str, list[dict[str, Any]]]) -> dict[str, float]:
    """Return measured core seconds as shares of those foretold, by step and of the whole."""
    sums = {step: [sum(row[k] for row in own) for k in ("foretold_s", "measured_s")] for step, own in rows.items()}
    sums["all"] = [sum(one[k] for one in sums.values()) for k in (0, 1)]
    return {step: rounded(measured / max(foretold, 1e-9)) for step, (foretold, measured) in sums.items()}


def rounded(value: float) -> float:
    """Return a number with three digits."""
    return float(f"{value:.3g}")


if __name__ == "__main__":
    raise SystemExit(main())
