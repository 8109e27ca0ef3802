"""capture.json: what a capture in our layout is called, and what it holds out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from smplxpp.capture.recording import Recording
from smplxpp.capture.splits import Splits
from smplxpp.core.files.atomic import atomic_write_text


def write_description(path: Path, recording: Recording, splits: Splits, frames: Sequence[int]) -> None:
    """Write capture.json.

    Args:
        path: the file.
        recording: gives name, frame rate, background and the set of labels.
        splits: cameras and frames to train on and to hold out.
        frames: all frames of the capture that is written, ascending.
    """
    description: dict[str, object] = {"name": recording.name}
    if recording.fps is not None:
        description["fps"] = recording.fps
    description |= {
        "background": None if recording.background is None else list(recording.background),
        "label_set": recording.label_set,
        "train_views": list(splits.train_cameras),
        "novel_views": list(splits.novel_view_cameras),
        "train_frames": _ranges(splits.train_frames, frames),
        "novel_pose_frames": _ranges(splits.novel_pose_frames, frames),
    }
    atomic_write_text(path, json.dumps(description, indent=1) + "\n")


def _ranges(chosen: Sequence[int], frames: Sequence[int]) -> list[list[int]]:
    """Return [first, last] of every run of `frames` that is chosen."""
    marks = np.concatenate([[0], np.isin(frames, chosen).astype(np.int8), [0]])
    starts, ends = np.flatnonzero(np.diff(marks) == 1), np.flatnonzero(np.diff(marks) == -1) - 1
    return [[int(frames[int(first)]), int(frames[int(last)])] for first, last in zip(starts, ends, strict=True)]
