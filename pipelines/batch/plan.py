"""What a batch will cost: hours of cores and GPUs, gigabytes and files of each step, and where a site breaks first.

    cost(step) = factor(step) x (fixed + rate x amount),   hours = max over resources of demand / supply

Amounts are images, megapixels and frames of a capture; rates are those of `Rates`, measured on single machines. A file
of the user's own rates replaces them, and the records of subjects that are done give factors for the rest (`learned`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import median
from typing import Any

from pipelines.batch.amounts import Facts, Work, facts_of, recipe_of, training_works
from pipelines.batch.jobs import Job
from pipelines.batch.rates import Rates, Site
from pipelines.batch.records import RUN_FOLDER, read_batch, read_job
from pipelines.runs.folders import read_record
from pipelines.runs.layout import MODEL_STAGES, REFINE_STAGE
from pipelines.runs.stage import MANIFEST
from smplxpp.core.errors import InputError


@dataclass(frozen=True)
class Cost:
    """What a step needs.

    Attributes:
        core_hours: of one core.
        gpu_hours: of one GPU.
        read_gb: read from the shared disk.
        written_gb: written there, and kept.
        files: opened or made there.
        made: files made there, and kept.
        unsure_hours: core hours, or of a GPU where it has one, that it may take more or fewer: what only the work
            itself finds out.
    """

    core_hours: float = 0.0
    gpu_hours: float = 0.0
    read_gb: float = 0.0
    written_gb: float = 0.0
    files: float = 0.0
    made: float = 0.0
    unsure_hours: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        return Cost(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(Cost)))

    def times(self, share: float) -> Cost:
        """Return the cost times a number."""
        return Cost(*(getattr(self, one.name) * share for one in fields(Cost)))


def cost_of(
    step: str, facts: Facts, rates: Rates, *, options: Mapping[str, Any] | None = None, gpu: bool = False
) -> Cost:
    """Return what a step costs for a subject, at the most bytes that an image may have.

    Args:
        step: convert, check, reconstruct (every frame), register, build, train, evaluate, export, web.
        facts: of the subject.
        rates: of the site.
        options: of the training, by its names.
        gpu: whether training and evaluation have one.

    Raises:
        InputError: a preset without a rate on this kind of machine.

    Example:
        >>> cost = cost_of("convert", Facts(6000, 48, 3.0, 2.0), Rates())
        >>> round(cost.core_hours), round(cost.written_gb)
        (37, 302)
    """
    image_mb = facts.megapixels * rates.convert_mb_mp[1]
    seconds, gpu_hours, read, written, files, made = rates.start_s, 0.0, 0.0, 0.0, 10.0, 10.0
    if step == "convert":
        seconds += rates.convert_s_mp * facts.megapixels * facts.images
        # An image and its mask are two files here and there.
        read, written = facts.source_mb * facts.images, image_mb * facts.images
        files, made = 4.0 * facts.images, 2.0 * facts.images
    elif step == "check":
        opened = min(facts.images, rates.check_images)
        seconds += (rates.check_s[0] + rates.check_s[1] * facts.megapixels) * opened
        read, files = image_mb * opened, 2.0 * opened
    elif step == "reconstruct":
        seconds += rates.reconstruct_s_mp * facts.megapixels * facts.images
        read, written = image_mb * facts.images, rates.scan_mb * facts.frames
        files, made = 2.0 * facts.images, 2.0 * facts.frames
    elif step == "register":
        seconds += rates.register_s * facts.images
        files = 2.0 * facts.images
    elif step == "build":
        seconds += rates.build_s[0] + rates.build_s[1] * facts.scan_mb
        written, made = 0.5 * rates.run_mb, 100.0
    elif step in ("refine", "train"):
        stages = training_costs(facts, rates, options or {}, gpu=gpu)
        own = [cost for name, cost in stages.items() if step == "train" or name == step]
        return replace(sum(own, Cost(rates.start_s / 3600.0)), made=made)
    elif step == "evaluate":
        looks = _measured(facts)
        work = rates.models * looks
        gpu_hours = rates.evaluate_gpu_s * work / 3600.0 if gpu else 0.0
        seconds += rates.evaluate_s
        seconds += 3600.0 * gpu_hours if gpu else rates.evaluate_s_mp * facts.megapixels * work
        read, files = image_mb * looks, 2.0 * looks
    else:
        seconds += rates.export_s
    cost = Cost(seconds / 3600.0, gpu_hours, 1e-3 * read, 1e-3 * written, files, made)
    factor = rates.factors.get(step, 1.0)
    return replace(cost, core_hours=factor * cost.core_hours, gpu_hours=factor * cost.gpu_hours)


def training_costs(facts: Facts, rates: Rates, options: Mapping[str, Any], *, gpu: bool) -> dict[str, Cost]:
    """Return what each stage of a training costs, by the name of its step.

    On a GPU the hours of the preset are shared out as the seconds of a core are, by its share of the iterations.

    Args:
        facts: of the subject.
        rates: of the site.
        options: of `smplxpp train`, by its names.
        gpu: whether it has one.

    Raises:
        InputError: an option out of range, or a preset without a rate on a GPU.
        MissingExtraError: torch is not installed.
    """
    name, tracked = str(options.get("preset", "cpu")), facts.tracked or options.get("refine_poses") == "on"
    factor = rates.factors.get("train", 1.0)

    def seconds_of(chosen: Mapping[str, Any]) -> tuple[dict[str, Work], dict[str, float]]:
        works = training_works(recipe_of(chosen, tracked=tracked), facts, rates.training)
        return works, {step: work.takes(rates.training) for step, work in works.items()}

    works, seconds = seconds_of(options)
    whole = sum(seconds_of({"preset": name})[1].values())
    if gpu and name not in rates.train_gpu_hours:
        known = ", ".join(rates.train_gpu_hours)
        raise InputError(f"preset {name}", expected=f"one with a rate on a GPU: {known}", received=name)
    image_mb, out = facts.megapixels * rates.convert_mb_mp[1], {}
    for step, work in works.items():
        # A GPU's training keeps a core busy with reading. Each look reads an image and its mask.
        scale = (rates.train_gpu_hours[name] / whole if gpu else 1.0 / 3600.0) * rates.factors.get(step, factor)
        hours, unsure = scale * seconds[step], scale * work.unsure
        kept = 1e-3 * rates.run_mb / 2.0 / len(works)
        out[step] = Cost(hours, hours * gpu, 1e-3 * image_mb * work.reads, kept, 2.0 * work.reads, 3.0, unsure)
    return out


def plan_jobs(
    jobs: Sequence[Job], rates: Rates, site: Site, *, runs: Path | None = None
) -> tuple[dict[str, Cost], list[str]]:
    """Return what each step costs over all jobs, and the subjects whose captures cannot be looked at from here.

    Args:
        jobs: of a batch.
        rates: of the site.
        site: whether it has GPUs decides what trains.
        runs: RUNS, whose templates count where they are built.
    """
    costs: dict[str, Cost] = {}
    unknown: list[str] = []
    for job in jobs:
        train = job.options.get("train", {})
        run = None if runs is None else runs / job.subject / RUN_FOLDER
        place, protocol = job.capture, train.get("protocol")
        facts = facts_of(place, protocol=protocol, run=run) if place else Facts(1, 0, 0.0, 0.0, 0)
        if facts is None:
            unknown.append(job.subject)
            continue
        device = train.get("device", "auto")
        gpu = device == "cuda" or (device == "auto" and site.gpus > 0 and job.needs.gpus > 0)
        for step in job.steps:
            # A step of its own has refined them.
            own = {**train, "refine_poses": "off"} if step == "train" and "refine" in job.steps else train
            cost = cost_of(step, facts, rates, options=own, gpu=gpu)
            costs[step] = costs.get(step, Cost()) + cost
    # Captures at an address are taken to be like the others.
    seen = len(jobs) - len(unknown)
    if unknown and seen:
        costs = {step: cost.times((seen + len(unknown)) / seen) for step, cost in costs.items()}
    return costs, unknown


def _measured(facts: Facts) -> float:
    """Return how many images an evaluation measures with its defaults, see `ProtocolConfig`."""
    trained = facts.frames - facts.held_out_frames
    held_out = facts.held_out_cameras * facts.frames
    return held_out + 2.0 * facts.held_out_frames + 2.0 * trained / 4.0


def demands(costs: Iterable[Cost], site: Site) -> dict[str, float]:
    """Return the hours that each resource of a site is busy with costs; the largest is the least that they take."""
    whole = sum(costs, Cost())
    return {
        "cores": whole.core_hours / max(site.cores, 1),
        "GPUs": whole.gpu_hours / site.gpus if site.gpus else (float("inf") if whole.gpu_hours else 0.0),
        "bytes of the disk": (whole.read_gb + whole.written_gb) * 1e3 / site.disk_mb_s / 3600.0,
        "files of the disk": whole.files / site.files_s / 3600.0,
    }


def breaks_first(costs: Mapping[str, Cost], site: Site) -> str:
    """Return in a line what a site lacks, or what keeps a batch longest."""
    whole = sum(costs.values(), Cost())
    if whole.gpu_hours and not site.gpus:
        return "there is no GPU"
    if whole.written_gb > 1e3 * site.disk_tb:
        return f"the disk: {whole.written_gb / 1e3:,.1f} TB are written, {site.disk_tb:,.1f} TB are free"
    if whole.made > site.files:
        return f"the disk's inodes: {whole.made:,.0f} files are made, {site.files:,.0f} are free"
    busy = demands(costs.values(), site)
    what = max(busy, key=lambda name: busy[name])
    of = {"cores": "core_hours", "GPUs": "gpu_hours", "files of the disk": "files"}.get(what, "read_gb")
    step = max(costs, key=lambda name: getattr(costs[name], of))
    return f"{what}: busy for {busy[what]:,.1f} hours, most of all with {step}"


@dataclass(frozen=True)
class Spent:
    """What a step, or a stage of a training, was foretold to take and has taken of one subject.

    Attributes:
        subject: its name.
        what: name of the step or the stage.
        foretold: seconds of a core, or of a GPU where it had one.
        unsure: seconds more or fewer that were foretold.
        measured: seconds that it took.
    """

    subject: str
    what: str
    foretold: float
    unsure: float
    measured: float


def spent_in(runs: Path, rates: Rates) -> list[Spent]:
    """Return what the finished steps of a batch took, trainings by the stages whose manifests say so.

    Steps that needed more than one attempt, and stages that were continued, say too little and are left out.
    """
    out: list[Spent] = []
    stages = {stage.partition("_")[2]: stage for stage in (REFINE_STAGE, *MODEL_STAGES)}
    for job in read_batch(runs).jobs:
        record, folder = read_job(runs, job["subject"]), runs / job["subject"] / RUN_FOLDER
        facts = facts_of(job["capture"], run=folder) if record and job["capture"] else None
        if record is None or facts is None:
            continue
        for step in [step for step in record.steps if step.state == "done" and step.attempts == 1]:
            words = dict(zip(step.command, [*step.command[1:], ""], strict=True))
            options = {word[2:].replace("-", "_"): value for word, value in words.items() if word.startswith("--")}
            gpu, clock = bool(step.gpu), step.seconds if step.gpu else step.cpu_seconds
            try:
                rows = {step.step: (cost_of(step.step, facts, rates, options=options, gpu=gpu), clock)}
                costs = training_costs(facts, rates, options, gpu=gpu) if step.step in ("refine", "train") else {}
            except InputError:  # options of another version
                continue
            for name, cost in costs.items():
                with suppress(InputError, KeyError):  # a stage that was not asked for
                    manifest = read_record(folder / stages[name] / MANIFEST)
                    rows[name] = cost, manifest["seconds" if gpu else "core_seconds"]
            for what, (cost, measured) in rows.items():
                hours = cost.gpu_hours if gpu else cost.core_hours
                out.append(Spent(record.subject, what, 3600.0 * hours, 3600.0 * cost.unsure_hours, measured))
    return out


def learned(rates: Rates, spent: Iterable[Spent]) -> Rates:
    """Return rates with the factors that finished steps and stages show: the median of measured over foretold.

    Args:
        rates: that foretold.
        spent: by finished subjects.
    """
    ratios: dict[str, list[float]] = {}
    for one in spent:
        # Inside of a range nothing was foretold wrongly, and its nearer end counts else.
        nearest = min(max(one.measured, one.foretold - one.unsure), one.foretold + one.unsure)
        if one.measured > 0.0 and nearest > 0.0:
            ratios.setdefault(one.what, []).append(one.measured / nearest)
    found = {name: rates.factors.get(name, 1.0) * median(values) for name, values in ratios.items()}
    return replace(rates, factors={**rates.factors, **found})
