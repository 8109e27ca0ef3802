"""Choose the views of an evaluation: training views, held-out cameras, held-out frames; and whose pictures are kept."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from avatar.data.sequence import AvatarSequence
from avatar.metrics.view_quality import Box
from avatar.rig.rig import AvatarModel, Pose, PosedAvatar, Rig
from smplxpp.capture import Capture, Splits
from smplxpp.core import GeometryWarning, InputError, require_at_least, require_known, spread
from smplxpp.core.mesh import TriangleMesh

SETS: Mapping[str, str] = {
    "training": "training views",
    "novel_view": "novel views",
    "novel_pose": "novel poses",
    "novel_pose_training_view": "novel poses, training cameras",
}
"""Titles by name. In `novel_pose` held-out cameras see held-out frames, so that both are new."""


@dataclass(frozen=True, kw_only=True)
class ProtocolConfig:
    """Choice of the measured (camera, frame) pairs.

    Attributes:
        sets: names among `SETS`; empty: all sets with views.
        every: step in frames for held-out frames, and for training frames seen by held-out cameras.
        training_every: step in frames for training views and true surfaces; at least `every` is used.
        cameras_a_frame: number of training cameras measured in a frame, which take turns; held-out ones are all used.
        held_out_cameras: cameras to hold out; empty: those of the capture's splits.
        held_out_frames: frames to hold out; empty: those of the capture's splits.
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
        """Step in training frames between those with measured training views and surfaces."""
        return max(self.every, self.training_every)


@dataclass(frozen=True)
class ViewSet:
    """Set of views that are measured together.

    Attributes:
        name: among `SETS`.
        views: pairs of camera and frame, frame by frame.
    """

    name: str
    views: tuple[tuple[str, int], ...]

    @property
    def title(self) -> str:
        """The name of the set in tables and messages."""
        return SETS[self.name]

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames of the views, ascending, each once."""
        return tuple(sorted({frame for _, frame in self.views}))

    def spread(self, count: int) -> tuple[tuple[str, int], ...]:
        """Return at most `count` of the views, evenly from first to last."""
        return tuple(spread(self.views, count))


def view_sets(capture: Capture, config: ProtocolConfig) -> dict[str, ViewSet]:
    """Return the sets of an evaluation by name, in the order of `SETS`; files only have to exist and are not opened.

    Raises:
        InputError: a requested set is empty, or all are; unknown cameras or frames; a frame without parameters.
    """
    # Training cameras take turns from frame to frame, since all of them at every frame would dominate the evaluation.
    splits = measured_splits(capture, config)
    pairs = {
        "training": _taking_turns(capture, splits.train_cameras, splits.train_frames[:: config.training_step], config),
        "novel_view": capture.views(splits.novel_view_cameras, splits.train_frames[:: config.every]),
        "novel_pose": capture.views(splits.novel_view_cameras, splits.novel_pose_frames[:: config.every]),
        "novel_pose_training_view": _taking_turns(
            capture, splits.train_cameras, splits.novel_pose_frames[:: config.every], config
        ),
    }
    # Sets that were asked for have to hold views; without a request empty ones are left out.
    wanted = config.sets or tuple(name for name in SETS if pairs[name])
    sets = {name: ViewSet(name, tuple(pairs[name])) for name in SETS if name in wanted}
    _require_views(capture, sets)
    # A model can be posed only where the body's parameters are known.
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
    """Return the sets without views whose mask is empty; every view is read, so that bad files are found early.

    Raises:
        InputError: no view is left in a set; a damaged image, one of another size than its camera's, no mask.
    """
    # PSNR over the person has no value where the mask is empty.
    left = {}
    for name, one in sets.items():
        seen = [pair for pair in one.views if capture.foreground(*pair)[1].any()]
        if len(seen) < len(one.views):
            warnings.warn(
                f"{one.title}: no person in the masks of {len(one.views) - len(seen)} of {len(one.views)} views; "
                "they are left out",
                GeometryWarning,
                stacklevel=2,
            )
        left[name] = replace(one, views=tuple(seen))
    _require_views(capture, left)
    return left


def truth_frames(capture: Capture, config: ProtocolConfig, sets: Mapping[str, ViewSet]) -> dict[str, tuple[int, ...]]:
    """Return the frames with a measured true surface, "training" and "held_out", for the parts that the sets use.

    These are the first frames with surface and parameters of every `every` held-out frames in a row, and of every
    `training_step` training frames. Frames with measured views need no surface.
    """
    if capture.recording.meshes is None:
        return {}
    # Frames are taken block by block, so that a frame without a surface is replaced by the next one and not lost.
    splits = measured_splits(capture, config)
    # Novel poses are held-out frames; all other sets show training frames.
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
    """Return the capture's splits, with the held-out cameras and frames of the configuration."""
    require_known("held-out cameras", config.held_out_cameras, capture.cameras)
    require_known("held-out frames", config.held_out_frames, capture.frames)
    # What is held out on request is taken from the training part, so that no view is in both.
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
    """Return views of a few cameras a frame, the next ones in the next frame, so that all cameras are used."""
    # A window of `cameras_a_frame` cameras advances through those that have an image of the frame.
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
            f"views of capture {capture.name} to measure",
            expected=f"some for {', '.join(empty)}" if empty else "some",
            received=f"none; {len(splits.novel_view_cameras)} cameras and {len(splits.novel_pose_frames)} frames are "
            f"held out, images of {int(capture.presence().any(axis=0).sum())} frames are there",
            remedy="hold some out with --hold-out and --hold-out-frames, choose other --sets, or check the masks",
        )


class AsNew(nn.Module):
    """An avatar that draws every frame as a new pose, without the frame's code, as it does live.

    Args:
        model: the avatar; its loose clothes are simulated as they are in new poses.
    """

    rig: Rig

    def __init__(self, model: AvatarModel) -> None:
        super().__init__()
        self.model, self.rig = model, model.rig

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar without the code of a frame."""
        return self.model(pose.without_code(), camera_centers)


def new_pose(sequence: AvatarSequence, frame: int) -> Pose:
    """Return the pose of any frame as a live player has it: without a code, with simulated clothes."""
    if frame not in sequence.train_frames:
        return sequence.pose(frame)
    return replace(sequence.as_new_pose(frame), known=None)


@dataclass(frozen=True, eq=False)
class ShownView:
    """Pictures of one view on the capture's background.

    Attributes:
        set: of views, among `protocol.SETS`.
        camera: name of the camera.
        frame: number of the frame.
        truth: the photograph, sRGB.
        rendered: pictures by model, sRGB.
        head: box of the head; None where it is not in the image.
        chosen: "evenly" among the views of its set, or "worst": the last model's PSNR of the person is the lowest of
            the set.
    """

    set: str
    camera: str
    frame: int
    truth: UInt8[np.ndarray, "H W 3"]
    rendered: dict[str, UInt8[np.ndarray, "H W 3"]]
    head: Box | None
    chosen: Literal["evenly", "worst"] = "evenly"


@dataclass(frozen=True, eq=False)
class ShownSurface:
    """Posed meshes of one frame for pictures.

    Attributes:
        set: "training" or "held_out".
        frame: number of the frame.
        truth: the true surface.
        posed: meshes by model, "skinning alone" first; models whose mesh only follows the joints are left out.
    """

    set: str
    frame: int
    truth: TriangleMesh
    posed: dict[str, TriangleMesh]


class Gallery:
    """A selection of views of a running evaluation, which holds no other pictures.

    Args:
        sets: all views of the evaluation.
        count: number of evenly spread views of each set; 0: none, and no worst one either.
    """

    def __init__(self, sets: Mapping[str, ViewSet], count: int) -> None:
        # The even choice is known beforehand, so that no other picture is held but the worst of each set so far.
        self._order = list(sets)
        self._evenly = {(name, *pair) for name, one in sets.items() for pair in one.spread(count)}
        self._with_worst = count > 0
        self._kept: list[ShownView] = []
        self._worst: dict[str, tuple[float, ShownView]] = {}

    def pass_by(self, view: ShownView, psnr: float) -> None:
        """Keep a view if it was chosen, or if its PSNR is the lowest of its set so far.

        Args:
            view: with its pictures.
            psnr: dB over the person, of the last model.
        """
        if (view.set, view.camera, view.frame) in self._evenly:
            self._kept.append(view)
        if self._with_worst and (view.set not in self._worst or psnr < self._worst[view.set][0]):
            self._worst[view.set] = psnr, replace(view, chosen="worst")

    def views(self) -> tuple[ShownView, ...]:
        """Return the kept views in the order of sets, each set's worst view last, even if it was also kept evenly."""
        # In the order of the sets, then by frame and camera.
        worst = [view for _, view in self._worst.values()]
        kept = [*self._kept, *worst]
        return tuple(
            sorted(kept, key=lambda one: (self._order.index(one.set), one.chosen == "worst", one.frame, one.camera))
        )
