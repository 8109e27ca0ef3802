"""What a registration sees of a person, in any mixture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Integer, UInt8

from smplxpp.core.camera import Camera
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams

ViewMap = Callable[[str, int], "UInt8[np.ndarray, 'H W'] | None"]
"""Reads a map of a camera and a frame, None where there is none."""


@dataclass(frozen=True, eq=False)
class ScanObservation:
    """A scan of one frame.

    Attributes:
        mesh: world, metres.
        labels: of its vertices, ids of `smplxpp.core.labels`, negative where not known; None: none at all.
    """

    mesh: TriangleMesh
    labels: Integer[np.ndarray, " V"] | None = None


@dataclass(frozen=True, eq=False)
class Observations:
    """Everything that a registration may use; held-out cameras are never in it.

    Attributes:
        frames: numbers of the frames, ascending.
        cameras: those that may be used, by name.
        keypoints: of some of these cameras.
        mask: opacity of the person, 255 inside. labels: ids of `smplxpp.core.labels`, 255 (background) elsewhere. Both
            in the cameras' pixels; None: nothing of the kind.
        scans: by frame.
        initial: a fit to start from, a row a frame.
        shape_frames: those that the shape, and whatever else all frames share, is solved on; None: all. Frames held out
            are none of them: they get their poses alone.
        fps: frames a second, None where not known.
    """

    frames: tuple[int, ...]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    keypoints: Mapping[str, Keypoints2D] = field(default_factory=dict)
    mask: ViewMap | None = None
    labels: ViewMap | None = None
    scans: Mapping[int, ScanObservation] = field(default_factory=dict)
    initial: BodyParams | None = None
    shape_frames: tuple[int, ...] | None = None
    fps: float | None = None
