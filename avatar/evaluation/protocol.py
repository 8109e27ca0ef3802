"""Which views an evaluation looks at: training views, held-out cameras, held-out frames."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from smplxpp.capture import Capture
from smplxpp.capture.splits import Splits
from smplxpp.core import GeometryWarning, InputError, require_at_least, require_known, spread

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
        every: every n-th frame of what is held out, from the first on: of the held-out frames, and of the training
            frames as held-out cameras see them.
        training_every: every n-th training frame of the training views and of the true surfaces; never more of them
            than `every` takes.
        cameras_a_frame: of the training cameras, which take turns from frame to frame; held-out ones are all taken.
        held_out_cameras, held_out_frames: in the place of those that the capture's splits hold out.
    """

    sets: tuple[str, ...] = ()
    every: int = 1
    training_every: int = 4
    cameras_a_frame: int = 2
    held_out_cameras: tuple[str, ...] = ()
    held_out_frames: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        require_known("evaluation sets", self.sets, SETS)
        for name in ("every", "training_every", "cameras_a_frame"):
            require_at_least(f"evaluation: {name}", getattr(self, name), 1)

    @property
    def training_step(self) -> int:
        """Every n-th training frame is seen from training cameras, and has its surface measured."""
        return max(self.every, self.training_every)


@dataclass(frozen=True)
class ViewSet:
    """Set of views that are measured together.

    Attributes:
        name: among `SETS`. views: (camera, frame), frame by frame.
    """

    name: str
    views: tuple[tuple[str, int], ...]

    @property
    def title(self) -> str:
        """The set's name for readers."""
        return SETS[self.name]

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames of the views, ascending, each once."""
        return tuple(sorted({frame for _, frame in self.views}))

    def spread(self, count: int) -> tuple[tuple[str, int], ...]:
        """At most `count` of the views, evenly from first to last."""
        return tuple(spread(self.views, count))


def view_sets(capture: Capture, config: ProtocolConfig) -> dict[str, ViewSet]:
    """The sets of an evaluation by name, in the order of `SETS`; decided by files that exist, none is opened.

    Raises:
        InputError: a set that was asked for is empty, or all are; unknown cameras or frames; a frame without
            parameters.
    """
    splits = measured_splits(capture, config)
    pairs = {
        "training": _taking_turns(capture, splits.train_cameras, splits.train_frames[:: config.training_step], config),
        "novel_view": capture.views(splits.novel_view_cameras, splits.train_frames[:: config.every]),
        "novel_pose": capture.views(splits.novel_view_cameras, splits.novel_pose_frames[:: config.every]),
        "novel_pose_training_view": _taking_turns(
            capture, splits.train_cameras, splits.novel_pose_frames[:: config.every], config
        ),
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

    Of every `every` held-out frames in a row, and of every `training_step` training frames, the first that has a
    surface and parameters: surfaces need not be there for the frames that views are measured on.
    """
    if capture.recording.meshes is None:
        return {}
    splits = measured_splits(capture, config)
    wanted = {"held_out" if name.startswith("novel_pose") else "training" for name in sets}
    out = {}
    for name, frames, step in (
        ("training", splits.train_frames, config.training_step),
        ("held_out", splits.novel_pose_frames, config.every),
    ):
        if name in wanted:
            blocks = [frames[k : k + step] for k in range(0, len(frames), step)]
            found = [next((f for f in block if _has_truth(capture, f)), None) for block in blocks]
            out[name] = tuple(f for f in found if f is not None)
    return {name: frames for name, frames in out.items() if frames}


def _has_truth(capture: Capture, frame: int) -> bool:
    return capture.truth_mesh(frame) is not None and capture.params(frame) is not None


def measured_splits(capture: Capture, config: ProtocolConfig) -> Splits:
    """The capture's splits with the user's choice of what is held out."""
    require_known("held-out cameras", config.held_out_cameras, capture.cameras)
    require_known("held-out frames", config.held_out_frames, capture.frames)
    splits = capture.splits
    if config.held_out_cameras:
        train = tuple(name for name in capture.cameras if name not in config.held_out_cameras)
        splits = replace(splits, train_cameras=train, novel_view_cameras=config.held_out_cameras)
    if config.held_out_frames:
        chosen = tuple(sorted(config.held_out_frames))
        frames = tuple(frame for frame in splits.train_frames if frame not in chosen)
        splits = replace(splits, train_frames=frames, novel_pose_frames=chosen)
    return splits


def _taking_turns(
    capture: Capture, cameras: Sequence[str], frames: Sequence[int], config: ProtocolConfig
) -> list[tuple[str, int]]:
    """A few cameras a frame, the next ones in the next frame, so that all of them are looked through."""
    out, turn = [], 0
    for frame in frames:
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
