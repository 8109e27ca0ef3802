"""Define the data of a registration: its inputs (`Observations`), options (`RegisterConfig`) and result (`BodyFit`)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float64, Integer, UInt8

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, Camera, Keypoints2D, TriangleMesh, require_at_least, require_positive
from smplxpp.core.errors import GeometryWarning, InputError, one_line

ViewMap = Callable[[str, int], "UInt8[np.ndarray, 'H W'] | None"]
"""Reads a map of a camera and a frame, None where there is none."""


@dataclass(frozen=True, eq=False)
class ScanObservation:
    """Scan of one frame with its labels.

    Attributes:
        mesh: in world coordinates, metres.
        labels: ids of `smplxpp.core.labels` for its vertices, negative where unknown; None if the scan has no labels.
    """

    mesh: TriangleMesh
    labels: Integer[np.ndarray, " V"] | None = None

    __repr__ = one_line


@dataclass(frozen=True)
class StartNoise:
    """Standard deviations of the errors of an initial fit.

    Attributes:
        pose: of each joint's rotation, radians.
        transl: of the translation, metres.
        shape: of each coefficient of betas.
    """

    pose: float
    transl: float
    shape: float


@dataclass(frozen=True, eq=False)
class Observations:
    """Everything that a registration may use; it never contains held-out cameras.

    Attributes:
        frames: numbers of the frames, ascending.
        cameras: cameras that may be used, by name.
        keypoints: keypoints of some of these cameras, by camera name.
        mask: reads the opacity of the person, 255 inside, in the camera's pixels; None if there are no masks.
        labels: reads ids of `smplxpp.core.labels`, 255 for background, in the camera's pixels; None if there are no
            label maps.
        scans: scans by frame.
        landmarks: points in world coordinates, metres, by frame and name (`smplxpp.core.keypoints`), as placed by hand.
        initial: an initial fit, one row a frame.
        initial_noise: standard deviations of the errors of `initial`; None to estimate them from its jitter.
        shape_frames: frames from which the shape, and whatever else all frames share, is estimated; None for all.
            Held-out frames are not among them and only receive poses.
        fps: frames a second, None if unknown.
        bare: vertices of the body that are known to be bare skin, in addition to those that labels show.
        shape: betas that all frames have, which are then not fitted: what chunks of one long take share.
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
    shape: Float64[np.ndarray, " B"] | None = None

    __repr__ = one_line


@dataclass(frozen=True)
class RegisterConfig:
    """Options of a registration. Lengths are in metres and angles in radians, chosen for an adult.

    Attributes:
        keypoint_px: lower bound of a keypoint's standard deviation, pixels of an image 640 pixels high; the deviation
            itself is measured by triangulation.
        landmark_m: standard deviation of a landmark on the skin; a landmark inside a limb has three times as much.
        silhouette_px: standard deviation of a mask's contour, pixels.
        silhouette_reach_m: cutoff of the robust kernel for bare rim vertices; the contour of another limb lies farther.
        scan_m: standard deviation of a scan where it shows skin.
        scan_reach_m: cutoff of the robust kernel for skin of a scan.
        tight_m: lower bound of the spread of the gap between body and cloth, so that tight cloth is never exact.
        cloth_share: information of a cloth point relative to an independent observation; neighbouring points of cloth
            move together.
        acceleration: scale of a joint's angular acceleration, rad/s^2; beyond it the Cauchy kernel flattens the cost.
        transl_acceleration: scale of the acceleration of the whole body, m/s^2.
        pose_prior: weight of the Gaussian pose prior; 0 leaves the joint limits alone.
        shape_prior: weight of the Gaussian prior of the shape, at which a fit begins.
        scan_samples: vertices drawn from a scan.
        rim_samples: vertices of the body that are tested for lying at a rim.
        joint_steps: Gauss-Newton steps on keypoints and landmarks alone.
        surface_steps: Gauss-Newton steps on all observations.
        shape_frames: upper bound of the number of frames, evenly spread, from which the shape is estimated.
        window: frames that are solved together; longer takes are solved in overlapping windows.
        seed: of the random samples.
    """

    keypoint_px: float = 1.0
    landmark_m: float = 0.005
    silhouette_px: float = 2.0
    silhouette_reach_m: float = 0.03
    scan_m: float = 0.003
    scan_reach_m: float = 0.03
    tight_m: float = 0.006
    cloth_share: float = 0.15
    acceleration: float = 6.0
    transl_acceleration: float = 1.5
    pose_prior: float = 1.0
    shape_prior: float = 1.0
    scan_samples: int = 4000
    rim_samples: int = 4000
    joint_steps: int = 15
    surface_steps: int = 10
    shape_frames: int = 60
    window: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        for name in (
            "keypoint_px",
            "landmark_m",
            "silhouette_px",
            "silhouette_reach_m",
            "scan_m",
            "scan_reach_m",
            "tight_m",
            "cloth_share",
            "acceleration",
            "transl_acceleration",
        ):
            require_positive(f"registration: {name}", getattr(self, name))
        for name in ("scan_samples", "rim_samples", "joint_steps", "shape_frames", "window"):
            require_at_least(f"registration: {name}", getattr(self, name), 1)
        for name in ("pose_prior", "shape_prior", "surface_steps", "seed"):
            require_at_least(f"registration: {name}", getattr(self, name), 0)


@dataclass(frozen=True, eq=False)
class BodyFit:
    """A body fitted to F frames.

    Attributes:
        frames: their numbers, ascending.
        params: one row a frame; all rows share one shape.
        confidence: of each joint in each frame, from 0 (known from the priors alone) to 1.
        residuals: by name, one number a frame, NaN where nothing of the kind was observed: `keypoints_px`,
            `landmarks_mm`, `silhouette_px`, `skin_mm` (bare skin of the scan to the body), `inside_mm` (depth of the
            scan's cloth inside the body).
        initial_residuals: the same of the initial fit; empty if there was none.
        notes: sentences about faults of the inputs and what was done about them.
    """

    frames: tuple[int, ...]
    params: BodyParams
    confidence: Float64[np.ndarray, "F J"]
    residuals: Mapping[str, Float64[np.ndarray, " F"]]
    initial_residuals: Mapping[str, Float64[np.ndarray, " F"]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    __repr__ = one_line


def check_observations(body: BodyModel, observed: Observations) -> None:
    """Refuse observations from which no registration can start, before any work is done.

    Raises:
        InputError: no frames, nothing to register to, or an initial fit of another length or body.
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
            "fit to start from: its v_shape is ignored; the shape is fitted in betas alone",
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
