"""Which views an evaluation looks at: training views, held-out cameras, held-out frames."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smplxpp.capture import Capture
from smplxpp.capture.splits import Splits
from smplxpp.core.errors import GeometryWarning, InputError

SETS: Mapping[str, str] = {
    "training": "training views",
    "novel_view": "novel views",
    "novel_pose": "novel poses",
    "novel_pose_training_view": "novel poses, training cameras",
}
"""Name -> title. `novel_pose` is seen from the held-out cameras, so that both are new."""


@dataclass(frozen=True, kw_only=True)
class ProtocolConfig:
    """Which (camera, frame) pairs are measured.

    Attributes:
        sets: names among `SETS`; empty: all that the capture has views for.
        every: every n-th frame of the training frames, and of the held-out ones, from the first on.
        cameras_a_frame: of the training cameras, which take turns from frame to frame; held-out ones are all taken.
        held_out_cameras, held_out_frames: in the place of those that the capture's splits hold out.
    """

    sets: tuple[str, ...] = ()
    every: int = 4
    cameras_a_frame: int = 2
    held_out_cameras: tuple[str, ...] = ()
    held_out_frames: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        unknown = [name for name in self.sets if name not in SETS]
        if unknown:
            raise InputError("evaluation sets", expected=f"among {', '.join(SETS)}", received=", ".join(unknown))
        for name in ("every", "cameras_a_frame"):
            if getattr(self, name) < 1:
                raise InputError(f"evaluation: {name}", expected="at least 1", received=str(getattr(self, name)))


@dataclass(frozen=True)
class ViewSet:
    """Views that are measured together.

    Attributes:
        name: among `SETS`. views: (camera, frame), frame by frame.
    """

    name: str
    views: tuple[tuple[str, int], ...]

    @property
    def title(self) -> str:
        return SETS[self.name]

    @property
    def frames(self) -> tuple[int, ...]:
        """Ascending, each once."""
        return tuple(sorted({frame for _, frame in self.views}))

    def spread(self, count: int) -> tuple[tuple[str, int], ...]:
        """At most `count` of the views, evenly from first to last."""
        picked = np.unique(np.linspace(0, len(self.views) - 1, min(count, len(self.views))).round().astype(int))
        return tuple(self.views[k] for k in picked)


def view_sets(capture: Capture, config: ProtocolConfig) -> dict[str, ViewSet]:
    """The sets of an evaluation by name, in the order of `SETS`; decided by files that exist, none is opened.

    Raises:
        InputError: a set that was asked for is empty, or all are; unknown cameras or frames; a frame without
            parameters.
    """
    splits = measured_splits(capture, config)
    pairs = {
        "training": _taking_turns(capture, splits.train_cameras, splits.train_frames, config),
        "novel_view": capture.views(splits.novel_view_cameras, splits.train_frames[:: config.every]),
        "novel_pose": capture.views(splits.novel_view_cameras, splits.novel_pose_frames[:: config.every]),
        "novel_pose_training_view": _taking_turns(capture, splits.train_cameras, splits.novel_pose_frames, config),
    }
    wanted = config.sets or tuple(name for name in SETS if pairs[name])
    sets = {name: ViewSet(name, tuple(pairs[name])) for name in SETS if name in wanted}
    _require_views(capture, sets)
    without = sorted({f for s in sets.values() for f in s.frames if capture.params(f) is None})
    if without:
        raise InputError(
            f"capture {capture.name}",
            expected="body parameters of every frame that is measured",
            received=f"none for {', '.join(map(str, without[:8]))}",
            remedy="name a file of parameters with --params",
        )
    return sets


def with_people(capture: Capture, sets: Mapping[str, ViewSet]) -> dict[str, ViewSet]:
    """The sets without views whose mask is empty; reads every view, so that a bad file ends it before work starts.

    Raises:
        InputError: a set in which no view is left; a damaged image, one of another size than its camera's, no mask.
    """
    left = {}
    for name, one in sets.items():
        seen = [pair for pair in one.views if capture.foreground(*pair)[1].any()]
        if len(seen) < len(one.views):
            warnings.warn(
                f"{one.title}: nobody in the masks of {len(one.views) - len(seen)} of {len(one.views)} views; "
                "they are left out",
                GeometryWarning,
                stacklevel=2,
            )
        left[name] = replace(one, views=tuple(seen))
    _require_views(capture, left)
    return left


def truth_frames(capture: Capture, config: ProtocolConfig, sets: Mapping[str, ViewSet]) -> dict[str, tuple[int, ...]]:
    """Frames whose true surface is measured, "training" and "held_out", as far as the sets look at either.

    Of every `every` frames in a row the first that has a surface and parameters: surfaces need not be there for the
    frames that views are measured on.
    """
    if capture.recording.meshes is None:
        return {}
    splits = measured_splits(capture, config)
    wanted = {"held_out" if name.startswith("novel_pose") else "training" for name in sets}
    out = {}
    for name, frames in (("training", splits.train_frames), ("held_out", splits.novel_pose_frames)):
        if name in wanted:
            blocks = [frames[k : k + config.every] for k in range(0, len(frames), config.every)]
            found = [next((f for f in block if _has_truth(capture, f)), None) for block in blocks]
            out[name] = tuple(f for f in found if f is not None)
    return {name: frames for name, frames in out.items() if frames}


def _has_truth(capture: Capture, frame: int) -> bool:
    return capture.truth_mesh(frame) is not None and capture.params(frame) is not None


def measured_splits(capture: Capture, config: ProtocolConfig) -> Splits:
    """The capture's splits with the user's choice of what is held out."""
    for what, chosen, known in (
        ("cameras", config.held_out_cameras, capture.cameras),
        ("frames", config.held_out_frames, capture.frames),
    ):
        unknown = [str(one) for one in chosen if one not in known]
        if unknown:
            have = ", ".join(map(str, list(known)[:40]))
            raise InputError(f"held-out {what}", expected=f"among {have}", received=", ".join(unknown))
    splits = capture.splits
    if config.held_out_cameras:
        train = tuple(name for name in capture.cameras if name not in config.held_out_cameras)
        splits = replace(splits, train_cameras=train, novel_view_cameras=config.held_out_cameras)
    if config.held_out_frames:
        chosen = tuple(sorted(config.held_out_frames))
        train = tuple(frame for frame in splits.train_frames if frame not in chosen)
        splits = replace(splits, train_frames=train, novel_pose_frames=chosen)
    return splits


def _taking_turns(
    capture: Capture, cameras: Sequence[str], frames: Sequence[int], config: ProtocolConfig
) -> list[tuple[str, int]]:
    """A few cameras a frame, the next ones in the next frame, so that all of them are looked through."""
    out, turn = [], 0
    for frame in frames[:: config.every]:
        there = [name for name in cameras if capture.file(name, frame) is not None]
        chosen = {there[(turn + k) % len(there)] for k in range(min(config.cameras_a_frame, len(there)))}
        out += [(name, frame) for name in there if name in chosen]
        turn += config.cameras_a_frame
    return out


def _require_views(capture: Capture, sets: Mapping[str, ViewSet]) -> None:
    empty = [one.title for one in sets.values() if not one.views]
    if empty or not sets:
        splits = capture.splits
        raise InputError(
            f"views of capture {capture.name} to measure on",
            expected=f"some for {', '.join(empty)}" if empty else "some",
            received=f"none; {len(splits.novel_view_cameras)} cameras and {len(splits.novel_pose_frames)} frames are "
            f"held out, images of {int(capture.presence().any(axis=0).sum())} frames are there",
            remedy="hold some out with --hold-out and --hold-out-frames, choose other --sets, or check the masks",
        )
