"""Define Recording, the files and calibration that a reader finds in a data set, and Splits, what of it is held out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Int64

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries
from smplxpp.core import BodyParams, Camera, InputError, Keypoints2D, TriangleMesh

KINDS = ("image", "mask", "label", "normal")
"""Kinds of image files of a view."""
TURNTABLE = "turntable"
"""Kind of a capture by one camera that stands still, before which a person turns and holds the pose roughly."""


@dataclass(frozen=True)
class Splits:
    """Training and held-out cameras and frames of a capture.

    Attributes:
        train_cameras: names of the cameras that training sees.
        novel_view_cameras: held-out cameras.
        train_frames: frames that training sees.
        novel_pose_frames: held-out frames.

    Raises:
        InputError: a camera or frame that is both trained on and held out.
    """

    train_cameras: tuple[str, ...]
    novel_view_cameras: tuple[str, ...]
    train_frames: tuple[int, ...]
    novel_pose_frames: tuple[int, ...]

    def __post_init__(self) -> None:
        for what, both in (
            ("cameras", sorted(set(self.train_cameras) & set(self.novel_view_cameras))),
            ("frames", sorted(set(self.train_frames) & set(self.novel_pose_frames))),
        ):
            if both:
                raise InputError(
                    f"split of {what}", expected="training and held-out sets apart", received=f"{both[:5]} in both"
                )

    @staticmethod
    def all_train(cameras: Iterable[str], frames: Iterable[int]) -> Splits:
        """Return splits that train on all cameras and frames."""
        return Splits(tuple(cameras), (), tuple(frames), ())

    def hold_out_cameras(self, every: int) -> Splits:
        """Return splits in which every n-th training camera, from the n-th on, is a novel view.

        Raises:
            InputError: `every` below 2, or no training camera would be left to hold out.
        """
        if every < 2 or every > len(self.train_cameras):
            raise InputError(
                "held-out cameras",
                expected=f"every n-th with n from 2 to the number of training cameras, {len(self.train_cameras)}",
                received=str(every),
            )
        held_out = self.train_cameras[every - 1 :: every]
        train = tuple(name for name in self.train_cameras if name not in held_out)
        return Splits(train, self.novel_view_cameras + held_out, self.train_frames, self.novel_pose_frames)

    def restricted(self, cameras: Sequence[str], frames: Sequence[int]) -> Splits:
        """Return the split without cameras and frames that are not among the given ones."""
        names, numbers = set(cameras), set(frames)
        return Splits(
            tuple(c for c in self.train_cameras if c in names),
            tuple(c for c in self.novel_view_cameras if c in names),
            tuple(f for f in self.train_frames if f in numbers),
            tuple(f for f in self.novel_pose_frames if f in numbers),
        )


@dataclass(frozen=True)
class Problem:
    """A defect of a capture that does not make the whole capture unusable.

    Attributes:
        message: description with the name of the file.
        camera: name of the camera concerned; None: all.
        frame: number of the frame concerned; None: all.
    """

    message: str
    camera: str | None = None
    frame: int | None = None


class ParamSource(Protocol):
    """Source of body parameters by frame number."""

    def frames(self) -> Int64[np.ndarray, " F"]:
        """Return the frames with parameters, ascending."""

    def read(self, frame: int) -> BodyParams:
        """Read the parameters of one of `frames()`."""


class MeshSource(Protocol):
    """Source of meshes by frame number."""

    def read(self, frame: int) -> TriangleMesh | None:
        """Read the mesh of a frame; None without one."""


class KeypointSource(Protocol):
    """Source of detected keypoints by camera."""

    def cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras with keypoints."""

    def frames(self) -> tuple[int, ...]:
        """Return the frames with keypoints in any camera."""

    def read(self, camera: str) -> Keypoints2D | None:
        """Read the keypoints of a camera in pixels of the images on disk; None without any."""

    def notes(self) -> tuple[str, ...]:
        """Return sentences about the people in view and who was taken."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Files and calibration of a data set, as its reader finds them, with nothing decoded.

    Attributes:
        name: name of the folder or of its description.
        root: folder of the data set.
        format: name of the reader.
        cameras: pinhole cameras by name, in the order of the data set, for whole undistorted images of the sizes on
            disk.
        files: for each kind ("image", "mask", "label", "normal") the files of each camera that has any. A mask's file
            may be the image; then its alpha channel is the mask.
        distortions: distortion of the cameras whose images are distorted on disk. The undistorted images keep their
            intrinsics and size.
        background: (3,) sRGB in [0, 1] that the images are composited on; None: photographs.
        splits: splits that the data set states, or None.
        label_set: label set of the label maps, a name known to `smplxpp.segment.map_labels`.
        params: source of body parameters, or None.
        meshes: source of true meshes, or None.
        keypoints: source of keypoints, or None.
        fps: frames per second; None if the data set does not state them.
        problems: defects that the reader found.
        protocol: name of the protocol whose files these are; None without one.
        protocols: names of the protocols of the capture.
        kind: `TURNTABLE` for a person who turns before one camera; None: all cameras see the same moment.
    """

    name: str
    root: Path
    format: str
    cameras: Mapping[str, Camera]
    files: Mapping[str, Mapping[str, FileSeries]]
    distortions: Mapping[str, Distortion] = field(default_factory=dict)
    background: tuple[float, float, float] | None = None
    splits: Splits | None = None
    label_set: str = "capture"
    params: ParamSource | None = None
    meshes: MeshSource | None = None
    keypoints: KeypointSource | None = None
    fps: float | None = None
    problems: tuple[Problem, ...] = field(default=())
    protocol: str | None = None
    protocols: tuple[str, ...] = ()
    kind: str | None = None

    def __repr__(self) -> str:
        """One paragraph: a recording has millions of files."""
        return f"Recording({self.summary()})"

    def summary(self) -> str:
        """Return a summary in one sentence: name, layout, folder, cameras, sizes, frames, and numbers of files."""
        frames = self.frames()
        sizes = sorted({(camera.width, camera.height) for camera in self.cameras.values()})
        shown = [f"{width} x {height}" for width, height in sizes[:3]]
        shown += [f"and {len(sizes) - len(shown)} other sizes"] if len(sizes) > len(shown) else []
        there = [
            f"{sum(map(len, series.values()))} {kind}s" for kind, series in self.files.items() if any(series.values())
        ]
        there += [name for name in ("params", "meshes", "keypoints") if getattr(self, name) is not None]
        there += [f"protocol {self.protocol}"] if self.protocol else []
        there += [f"{len(self.problems)} problems"] if self.problems else []
        parts = [
            f"{self.name!r}, {self.format}, {str(self.root)!r}",
            f"{len(self.cameras)} cameras" + (f" of {', '.join(shown)} pixels" if shown else ""),
            f"{len(frames)} frames" + (f" {frames[0]} to {frames[-1]}" if frames else ""),
            ", ".join(there) or "nothing else",
        ]
        return "; ".join(parts)

    def series(self, kind: str, camera: str) -> FileSeries | None:
        """Return the files of a kind of a camera; None without any."""
        return self.files.get(kind, {}).get(camera)

    def frames(self) -> tuple[int, ...]:
        """Return all frames with an image in any camera; without any image, those with parameters, else keypoints."""
        images = [series.numbers for series in self.files.get("image", {}).values()]
        if images:
            return tuple(np.unique(np.concatenate(images)).tolist())
        if self.params is not None:
            return tuple(self.params.frames().tolist())
        return () if self.keypoints is None else self.keypoints.frames()
