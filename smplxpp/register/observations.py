"""What a registration sees of a person, in any mixture."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8

from smplxpp.body import BodyModel
from smplxpp.core.camera import Camera
from smplxpp.core.errors import GeometryWarning, InputError
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


@dataclass(frozen=True)
class StartNoise:
    """Standard deviations of a fit to start from.

    Attributes:
        pose: of each joint's turn, radians. transl: metres. shape: betas.
    """

    pose: float
    transl: float
    shape: float


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
        landmarks: points in the world, metres, by frame and name (`smplxpp.core.keypoints`), as placed by hand.
        initial: a fit to start from, a row a frame. initial_noise: how wrong it is; None: as its own jitter tells.
        shape_frames: those that the shape, and whatever else all frames share, is solved on; None: all. Frames held out
            are none of them: they get their poses alone.
        fps: frames a second, None where not known.
        bare: vertices of the body that are known to be skin, beside those that label maps and labelled scans show.
    """

    frames: tuple[int, ...]
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    keypoints: Mapping[str, Keypoints2D] = field(default_factory=dict)
    mask: ViewMap | None = None
    labels: ViewMap | None = None
    scans: Mapping[int, ScanObservation] = field(default_factory=dict)
    landmarks: Mapping[int, Mapping[str, Float[np.ndarray, " 3"]]] = field(default_factory=dict)
    initial: BodyParams | None = None
    initial_noise: StartNoise | None = None
    shape_frames: tuple[int, ...] | None = None
    fps: float | None = None
    bare: Bool[np.ndarray, " V"] | None = None


def check_observations(body: BodyModel, observed: Observations) -> None:
    """Refuse what nothing can be registered to, before work starts.

    Raises:
        InputError: no frames, nothing to register to, a fit of another length or body.
    """
    if not observed.frames:
        raise InputError("registration", expected="at least one frame", received="none")
    if not (observed.keypoints or observed.landmarks or observed.scans or observed.mask or observed.initial):
        raise InputError(
            "registration",
            expected="keypoints, landmarks, masks, scans or a fit",
            received="none of them",
            remedy="give keypoints of a detector (docs/registration.md), or body parameters to start from",
        )
    if observed.initial is None and not observed.keypoints and not any(observed.landmarks.values()):
        raise InputError(
            "registration",
            expected="keypoints, landmarks, or a fit to start from",
            received="none of them",
            remedy="detect keypoints in the images, place landmarks on the scan, or give parameters that are roughly "
            "right with --params",
        )
    if observed.initial is not None:
        _check_initial(body, observed.initial, len(observed.frames))


def _check_initial(body: BodyModel, initial: BodyParams, frames: int) -> None:
    if len(initial) != frames:
        raise InputError("fit to start from", expected=f"{frames} frames", received=f"{len(initial)} frames")
    if initial.v_shape is not None:
        warnings.warn(
            "fit to start from: its v_shape is left aside, the shape is fitted in betas alone",
            GeometryWarning,
            stacklevel=3,
        )
    for name, have, known in (
        ("betas", initial.betas.shape[1], body.num_betas),
        ("expression", initial.expression.shape[1], body.num_expressions),
    ):
        if have > known and np.abs(getattr(initial, name)[:, known:]).max() > 0:
            raise InputError(
                f"fit to start from: {name}",
                expected=f"at most {known} numbers, as the body {body.name!r} has",
                received=f"{have}",
                remedy="name the body that the parameters were fitted with (--body)",
            )
