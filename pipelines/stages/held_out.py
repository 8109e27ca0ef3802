"""What models have seen, by the record of the stages that made them, against what is held out."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.runs.stage import MANIFEST, StageRecord, read_manifest
from smplxpp.capture.splits import Splits
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_list, as_object, as_text

log = logging.getLogger(__name__)
NAMED = 8
"""Cameras and frames that a refusal names."""
TRAIN_ANEW = "train without them (smplxpp train --force; the capture's split says which frames are held out)"


@dataclass(frozen=True)
class Seen:
    """Cameras and frames that a model learned from, by itself or through what it was made from."""

    cameras: frozenset[str]
    frames: frozenset[int]


def seen_of(record: StageRecord) -> Seen | None:
    """What the model of a stage has seen, by the stage's manifest; None where it does not say.

    Raises:
        InputError: a manifest that says it in other kinds of values.
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
    """What the model of a stage has seen; a model without a record of it is logged."""
    manifest = read_manifest(run / stage)
    seen = None if manifest is None else seen_of(StageRecord(run / stage, manifest, ran=False))
    if seen is None:
        log.warning("%s: what its model has seen is not recorded; whether views are novel is not known", stage)
        return Seen(frozenset(), frozenset())
    return seen


def refuse_seen(run: Path, stages: Iterable[str], splits: Splits, *, anew: str = TRAIN_ANEW) -> None:
    """Refuse models that have seen cameras or frames which count as held out; `anew` says how to make others.

    Raises:
        InputError: names the stages and what they saw.
    """
    each = {name: _seen_by(run, name) for name in sorted(stages)}
    cameras = [camera for camera in splits.novel_view_cameras if any(camera in one.cameras for one in each.values())]
    frames = [frame for frame in splits.novel_pose_frames if any(frame in one.frames for one in each.values())]
    if not cameras and not frames:
        return
    known = sorted({*splits.train_cameras, *splits.novel_view_cameras})
    never = [camera for camera in known if all(camera not in one.cameras for one in each.values())]
    names = [name for name, one in each.items() if one.cameras.intersection(cameras) or one.frames.intersection(frames)]
    remedy = anew
    if cameras and never:
        remedy = f"hold out what they did not see (--hold-out {' '.join(never[:NAMED])}), or {anew}"
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
