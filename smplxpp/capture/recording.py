"""Recording: what a reader finds in a data set's folder, with nothing decoded yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Int64

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries
from smplxpp.capture.splits import Splits
from smplxpp.core.camera import Camera
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams

_SHOWN_SIZES = 3
KINDS = ("image", "mask", "label", "normal")


@dataclass(frozen=True)
class Problem:
    """Something wrong in a capture that does not stop it from being used.

    Attributes:
        message: what is wrong, with the file's name.
        camera, frame: what it concerns; None: all.
    """

    message: str
    camera: str | None = None
    frame: int | None = None


class ParamSource(Protocol):
    """Body parameters by frame."""

    def frames(self) -> Int64[np.ndarray, " F"]:
        """The frames that have parameters, ascending."""

    def read(self, frame: int) -> BodyParams:
        """Read one frame that is among `frames()`."""


class MeshSource(Protocol):
    """Meshes by frame."""

    def read(self, frame: int) -> TriangleMesh | None:
        """The frame's mesh, None where there is none."""


class KeypointSource(Protocol):
    """Keypoints by camera."""

    def cameras(self) -> tuple[str, ...]:
        """The cameras that have keypoints."""

    def read(self, camera: str) -> Keypoints2D | None:
        """Read a camera's keypoints, in pixels of the images on disk; None where there are none."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A data set's folder, found by its reader.

    Attributes:
        name, root, format: the folder's name, the folder, the reader's name.
        cameras: by name, in the set's order, for whole images of the sizes on disk.
        distortions: lenses of the cameras whose images are distorted on disk; `cameras` holds the pinhole cameras of
            the undistorted images, which keep the intrinsics and the size of the distorted ones.
        files: for each kind ("image", "mask", "label", "normal") the series of each camera that has one. A mask's file
            may be the image's: then its alpha channel counts.
        background: (3,) sRGB in [0, 1] that the images are already composited on; None: photographs.
        splits: as the set states them, or None.
        label_set: numbers of the label maps, a name known to `smplxpp.segment.map_labels`.
        params, meshes, keypoints: or None.
        fps: frames a second, or None where the set does not say.
        problems: what the reader had to leave out.
        protocol: name of the protocol whose files these are, None without one. protocols: names of those that the
            capture has.
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

    def __repr__(self) -> str:
        """One paragraph: a recording has millions of files."""
        return f"Recording({self.summary()})"

    def summary(self) -> str:
        """What there is, in a sentence: name, layout, folder, cameras, sizes, frames, and how many files of a kind."""
        frames = self.frames()
        sizes = sorted({(camera.width, camera.height) for camera in self.cameras.values()})
        shown = [f"{width} x {height}" for width, height in sizes[:_SHOWN_SIZES]]
        shown += [f"and {len(sizes) - len(shown)} other sizes"] if len(sizes) > len(shown) else []
        there = [
            f"{sum(map(len, series.values()))} {kind}s" for kind, series in self.files.items() if any(series.values())
        ]
        there += [name for name in ("params", "meshes", "keypoints") if getattr(self, name) is not None]
        there += [f"protocol {self.protocol}"] if self.protocol else []
        there += [f"{len(self.problems)} problems"] if self.problems else []
        said = [
            f"{self.name!r}, {self.format}, {str(self.root)!r}",
            f"{len(self.cameras)} cameras" + (f" of {', '.join(shown)} pixels" if shown else ""),
            f"{len(frames)} frames" + (f" {frames[0]} to {frames[-1]}" if frames else ""),
            ", ".join(there) or "nothing else",
        ]
        return "; ".join(said)

    def series(self, kind: str, camera: str) -> FileSeries | None:
        """The files of a kind for a camera."""
        return self.files.get(kind, {}).get(camera)

    def frames(self) -> tuple[int, ...]:
        """All frames with an image in any camera; without any image, those with parameters."""
        images = [series.numbers for series in self.files.get("image", {}).values()]
        if images:
            return tuple(np.unique(np.concatenate(images)).tolist())
        return () if self.params is None else tuple(self.params.frames().tolist())
