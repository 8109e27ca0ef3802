"""Rates of the steps of a chain, and what a site has: ours, or those of a file of the user."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pipelines.batch.amounts import TrainingRates
from smplxpp.core.errors import require_known
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
        evaluate_s: opening of an evaluation's models, and its figures.
        evaluate_s_mp: rendering and comparison, a megapixel of a measured image and model, on a core.
        evaluate_gpu_s: the same on a GPU, an image and model.
        models: models that are measured.
        export_s: bundle and page.
        run_mb: MB of a run without its surfaces: template, models, pictures, reports.
        scan_mb: of a reconstructed surface.
        factors: by step and by stage of a training, what measured costs of a site are of those foretold.
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
    evaluate_s: float = 10.0
    evaluate_s_mp: float = 1.5
    evaluate_gpu_s: float = 0.1
    models: int = 3
    export_s: float = 0.5
    run_mb: float = 150.0
    scan_mb: float = 8.0
    factors: Mapping[str, float] = field(default_factory=dict)


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
