"""Compare the cameras and frames that models were trained on, as their stages record, with the held-out ones."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.runs.stage import MANIFEST, StageRecord, read_manifest
from smplxpp.capture.recording import Splits
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_list, as_object, as_text

log = logging.getLogger(__name__)
NAMED = 8
"""Largest number of cameras or frames that an error message lists."""
TRAIN_AGAIN = "train without them (smplxpp train --force; the capture's split says which frames are held out)"


@dataclass(frozen=True)
class Seen:
    """Cameras and frames that a model learned from, directly or through the models it was made from."""

    cameras: frozenset[str]
    frames: frozenset[int]


def seen_of(record: StageRecord) -> Seen | None:
    """Return the cameras and frames that the model of a stage has seen; None where its manifest has no record.

    Raises:
        InputError: a manifest with values of another type.
    """
    subject = f"file {record.folder / MANIFEST}: seen"
    value = record.manifest["numbers"].get("seen")
    if value is None:
        return None
    found = as_object(value, subject=subject)
    cameras = as_list(found.get("cameras", []), subject=f"{subject}: cameras")
    frames = as_list(found.get("frames", []), subject=f"{subject}: frames")
    return Seen(
        frozenset(as_text(camera, subject=f"{subject}: camera") for camera in cameras),
        frozenset(as_integer(frame, subject=f"{subject}: frame") for frame in frames),
    )


def _seen_by(run: Path, stage: str) -> Seen:
    """Return what the model of a stage has seen; log a warning for a model without a record."""
    manifest = read_manifest(run / stage)
    seen = None if manifest is None else seen_of(StageRecord(run / stage, manifest, ran=False))
    if seen is None:
        log.warning("%s: what its model has seen is not recorded; whether views are novel is not known", stage)
        return Seen(frozenset(), frozenset())
    return seen


def refuse_seen(run: Path, stages: Iterable[str], splits: Splits, *, remedy: str = TRAIN_AGAIN) -> None:
    """Refuse models that have seen cameras or frames which count as held out.

    Args:
        run: folder of the run.
        stages: names of the stages that made the models.
        splits: the cameras and frames that count as held out.
        remedy: how to make models that have not seen them.

    Raises:
        InputError: names the stages and what they saw.
    """
    # Intersect what is held out now with what each model has learned from.
    each = {name: _seen_by(run, name) for name in sorted(stages)}
    cameras = [camera for camera in splits.novel_view_cameras if any(camera in one.cameras for one in each.values())]
    frames = [frame for frame in splits.novel_pose_frames if any(frame in one.frames for one in each.values())]
    if not cameras and not frames:
        return
    # Suggest cameras that no model has seen: holding out those needs no further training.
    known = sorted({*splits.train_cameras, *splits.novel_view_cameras})
    never = [camera for camera in known if all(camera not in one.cameras for one in each.values())]
    names = [name for name, one in each.items() if one.cameras.intersection(cameras) or one.frames.intersection(frames)]
    if cameras and never:
        remedy = f"hold out what they did not see (--hold-out {' '.join(never[:NAMED])}), or {remedy}"
    what = [f"{kind} {_named(values)}" for kind, values in (("cameras", cameras), ("frames", frames)) if values]
    raise InputError(
        f"held-out views of run {run}",
        expected="views that its models have not seen",
        received=f"{' and '.join(what)}, which {', '.join(names)} learned from",
        remedy=remedy,
    )


def _named(values: list[Any]) -> str:
    shown = ", ".join(map(str, values[:NAMED]))
    return shown if len(values) <= NAMED else f"{shown} and {len(values) - NAMED} more"
