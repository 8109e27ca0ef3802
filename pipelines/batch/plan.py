"""What a batch will cost: hours of cores and GPUs, gigabytes and files of each step, and where a site breaks first.

    cost(step) = factor(step) x (fixed + rate x amount),   hours = max over resources of demand / supply

Amounts are images, megapixels and frames of a capture; rates are those of `Rates`, measured on single machines. A file
of the user's own rates replaces them, and the records of subjects that are done give factors for the rest (`learned`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from statistics import median
from typing import Any

from pipelines.batch.amounts import Facts, TrainingRates, Work, facts_of, recipe_of, training_works
from pipelines.batch.jobs import Job
from smplxpp.core.errors import InputError, require_known
from smplxpp.core.files.json_file import as_list, as_number, as_object, read_json


@dataclass(frozen=True)
class Rates:
    """Rates of the steps: seconds of one core, hours of one GPU, bytes.

    Attributes:
        convert_s_mp: decoding, undistortion and writing, a megapixel written of photographs four times as large
            (capture_loader.json: 2.2 images of 3 megapixels a second).
        convert_mb_mp: least and most of a JPEG of quality 95 and its mask, MB a megapixel: a person on black, a room.
        check_s: `capture check`, an image and a megapixel of it, of at most `check_images` images.
        check_images: images that a check opens by default.
        start_s: a command's imports and first files.
        build_s: a template, and a MB of its scan: of PLY, a fifth for text.
        register_s: registration by keypoints, masks, labels and scans, a frame and camera (registration_*.json).
        reconstruct_s_mp: surface of a frame, a megapixel of all its cameras (reconstruction_*.json: 6 to 11).
        training: rates of the stages of a training on a CPU.
        train_gpu_hours: training on one H200 by preset (gpu*.json); `gpu` and `paper` are their iterations over steps
            that were timed of `paper` and of an earlier `gpu`; neither was run to its end.
        evaluate_s_mp: rendering and comparison, a megapixel of a measured image and model, on a core.
        evaluate_gpu_s: the same on a GPU, an image and model.
        models: models that are measured.
        export_s: bundle and page.
        run_mb: MB of a run without its surfaces: template, models, pictures, reports.
        scan_mb: of a reconstructed surface.
        factors: by step, what measured costs of a site are of those foretold.
    """

    convert_s_mp: float = 0.154
    convert_mb_mp: tuple[float, float] = (0.12, 0.35)
    check_s: tuple[float, float] = (0.014, 0.014)
    check_images: int = 2000
    start_s: float = 2.0
    build_s: tuple[float, float] = (12.0, 9.4)
    register_s: float = 0.12
    reconstruct_s_mp: float = 8.0
    training: TrainingRates = field(default_factory=TrainingRates)
    train_gpu_hours: Mapping[str, float] = field(
        default_factory=lambda: {"demo": 0.03, "cpu": 0.07, "paper-small": 0.1, "gpu": 4.0, "paper": 94.0}
    )
    evaluate_s_mp: float = 1.5
    evaluate_gpu_s: float = 0.1
    models: int = 3
    export_s: float = 0.5
    run_mb: float = 150.0
    scan_mb: float = 8.0
    factors: Mapping[str, float] = field(default_factory=dict)


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
    """

    core_hours: float = 0.0
    gpu_hours: float = 0.0
    read_gb: float = 0.0
    written_gb: float = 0.0
    files: float = 0.0
    made: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        return Cost(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(Cost)))

    def times(self, share: float) -> Cost:
        """Return the cost times a number."""
        return Cost(*(getattr(self, one.name) * share for one in fields(Cost)))


@dataclass(frozen=True)
class Site:
    """What a cluster has for the batch.

    Attributes:
        cores: that run at the same time.
        gpus: likewise.
        disk_tb: free on the shared disk.
        disk_mb_s: read or written by all machines together.
        files_s: opened or made by all machines together; a metadata server of NFS does some thousands.
        files: inodes that are free.
    """

    cores: int = 2
    gpus: int = 0
    disk_tb: float = 1.0
    disk_mb_s: float = 500.0
    files_s: float = 2000.0
    files: float = 1e9


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

    def seconds_of(chosen: Mapping[str, Any]) -> tuple[dict[str, Work], dict[str, float]]:
        works = training_works(recipe_of(chosen, tracked=tracked), facts, rates.training)
        return works, {step: work.takes(rates.training) for step, work in works.items()}

    works, seconds = seconds_of(options)
    whole = sum(seconds_of({"preset": name})[1].values())
    if gpu and name not in rates.train_gpu_hours:
        known = ", ".join(rates.train_gpu_hours)
        raise InputError(f"preset {name}", expected=f"one with a rate on a GPU: {known}", received=name)
    image_mb, factor, out = facts.megapixels * rates.convert_mb_mp[1], rates.factors.get("train", 1.0), {}
    for step, work in works.items():
        # A GPU's training keeps a core busy with reading. Each look reads an image and its mask.
        hours = seconds[step] / 3600.0
        hours = rates.train_gpu_hours[name] * seconds[step] / whole if gpu else hours
        kept = 1e-3 * rates.run_mb / 2.0 / len(works)
        cost = Cost(factor * hours, factor * hours * gpu, 1e-3 * image_mb * work.reads, kept, 2.0 * work.reads, 3.0)
        out[step] = cost
    return out


def plan_jobs(jobs: Sequence[Job], rates: Rates, site: Site) -> tuple[dict[str, Cost], list[str]]:
    """Return what each step costs over all jobs, and the subjects whose captures cannot be looked at from here.

    Args:
        jobs: of a batch.
        rates: of the site.
        site: whether it has GPUs decides what trains.
    """
    costs: dict[str, Cost] = {}
    unknown = []
    for job in jobs:
        train = job.options.get("train", {})
        facts = facts_of(job.capture, protocol=train.get("protocol")) if job.capture else Facts(1, 0, 0.0, 0.0, 0)
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


def read_rates(path: Path | None) -> tuple[Rates, Site]:
    """Read a JSON file with entries of `Rates` and, under "site", of `Site`; the defaults for None.

    Raises:
        InputError: a name that is none of theirs, or a value of another kind.
    """
    if path is None:
        return Rates(), Site()
    content = as_object(read_json(path, subject="rates"), subject=f"rates {path}")
    site = as_object(content.pop("site", {}), subject=f"rates {path}: site")
    for given, cls in ((content, Rates), (site, Site)):
        require_known(f"rates {path}", given, [one.name for one in fields(cls)])
    for name, value in {**content, **site}.items():
        for one in _leaves(value):
            as_number(one, subject=f"rates {path}: {name}", least=0.0)
    for name in {"convert_mb_mp", "check_s", "build_s"} & content.keys():
        first, second = as_list(content[name], subject=f"rates {path}: {name}")
        content[name] = (first, second)
    # What a file does not name keeps its rate.
    if "train_gpu_hours" in content:
        content["train_gpu_hours"] = {**Rates().train_gpu_hours, **content["train_gpu_hours"]}
    if "training" in content:
        own, given = TrainingRates(), as_object(content["training"], subject=f"rates {path}: training")
        require_known(f"rates {path}: training", given, [one.name for one in fields(TrainingRates)])
        merged: dict[str, Any] = dict(given)
        for name, usual in ((name, getattr(own, name)) for name in given):
            if isinstance(usual, dict):
                merged[name] = {**usual, **as_object(given[name], subject=f"rates {path}: training: {name}")}
            else:
                merged[name] = as_number(given[name], subject=f"rates {path}: training: {name}", least=0.0)
        content["training"] = replace(own, **merged)
    return Rates(**content), Site(**site)


def _leaves(value: Any) -> list[Any]:
    """Return the values in nested lists and objects."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return [value] if inside is None else [leaf for one in inside for leaf in _leaves(one)]


def learned(rates: Rates, spent: Mapping[str, Iterable[tuple[float, float]]]) -> Rates:
    """Return rates with the factors that finished steps show.

    Args:
        rates: that foretold.
        spent: by step, foretold and measured core-hours of each subject.
    """
    ratios: dict[str, Any] = {}
    for step, pairs in spent.items():
        found = [measured / foretold for foretold, measured in pairs if foretold > 0 and measured > 0]
        if found:
            ratios[step] = rates.factors.get(step, 1.0) * median(found)
    return replace(rates, factors={**rates.factors, **ratios})
