"""Register the body to observations, and measure the fit: limits, and distances of keypoints by camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.build.observe import Observed
from smplxpp.capture.recording import TURNTABLE
from smplxpp.core import ARRAY_NAMES, BodyParams, Check, InputError, ProgressCallback, StageOutput, ignore_progress
from smplxpp.register import BodyFit, LandmarkModel, Observations, RegisterConfig, follow, lost_frames, register
from smplxpp.register.turntable import TurntableConfig, register_turntable

CONFIDENT = 0.5
"""Mean confidence of the body's joints from which a frame counts as observed, not filled in by the priors."""
BODY_JOINTS = 22
"""Number of leading joints whose mean confidence is that of a frame: the body without face and fingers."""


@dataclass(frozen=True)
class Residual:
    """A kind of residual, with the limits of its median over frames.

    Attributes:
        words: what it is.
        unit: of its numbers.
        gate: up to where the median passes, and from where it fails. Pixels are in shares of the images' height.
    """

    words: str
    unit: str
    gate: tuple[float, float] | None = None


RESIDUALS: dict[str, Residual] = {
    # Gates in pixels are shares of the image's height, since pixels depend on the resolution; others are millimetres.
    "keypoints_px": Residual("keypoints to the body", "px", (0.01, 0.03)),
    "landmarks_mm": Residual("landmarks to the body", "mm", (20.0, 50.0)),
    "silhouette_px": Residual("silhouette to the mask", "px"),
    "skin_mm": Residual("bare skin to the scan", "mm", (8.0, 20.0)),
    "inside_mm": Residual("cloth of the scan inside the body", "mm", (5.0, 15.0)),
    "surface_mm": Residual("scan to the body", "mm"),
}
"""Residuals that have a title; others are shown by their name."""


@dataclass(frozen=True, eq=False)
class Registration:
    """Result of a registration of the body to observations.

    Attributes:
        fit: parameters, confidence and residuals of the frames that could be registered.
        observations: what it was registered to, with the fit that it started from.
        summary: residuals by frame, reprojection by camera, notes.
    """

    fit: BodyFit
    observations: Observations
    summary: dict[str, Any]


def register_observed(
    observed: Observed,
    body: BodyModel,
    *,
    at: int,
    config: RegisterConfig,
    progress: ProgressCallback = ignore_progress,
) -> tuple[Registration, StageOutput]:
    """Register the body to what was observed.

    Args:
        observed: see `observe`.
        body: the model.
        at: reference frame, where the body was found in a scan.
        config: of the solver.
        progress: called with what is being done, and the share of it that is done.

    Raises:
        InputError: not a single frame that could be registered.
    """
    observations = observed.observations
    lost: tuple[str, ...] = ()
    if observed.found is not None and not observations.keypoints:
        # Without keypoints only masks and scans tell the motion: follow them from the frame where the body was found.
        initial = follow(body, observations, observed.found, at=at, config=config, progress=progress)
        lost = lost_frames(body, observations, initial, at=at)
        observations = replace(observations, initial=initial)
    if observed.capture is not None and observed.capture.kind == TURNTABLE:
        if observations.shape is not None:
            raise InputError(
                "shape", expected="none: all frames of a turn share one pose and one shape", received="one"
            )
        # One camera sees no depth: the pose that all frames share gives it. The camera is known, and stands upright.
        turn = TurntableConfig(up_spread=3.0, solver=config)
        fit = register_turntable(body, observations, turn, progress=progress).fit
    else:
        # Gauss-Newton over pose, translation and one shape for all frames, from keypoints, masks, scans and priors.
        fit = register(body, observations, config, progress=progress)
    if not fit.frames:
        raise InputError(
            "registration",
            expected="a body in at least one frame",
            received=f"none in {len(observations.frames)} frames: {'; '.join(fit.notes) or 'no person was seen'}",
            remedy="look at the inputs with `smplxpp capture check`",
        )
    notes = (*observed.all_notes(), *fit.notes, *lost)
    content = summary(body, observations, fit, notes)
    # Medians are robust against the few frames in which a limb is hidden; a residual that no frame has is left out.
    medians = {
        when: {name: float(np.nanmedian(values)) for name, values in found.items() if np.isfinite(values).any()}
        for when, found in content["residuals"].items()
    }
    # Without a split all frames take part in the fit of the shape.
    shape_frames = observations.shape_frames or observations.frames
    numbers = {
        "frames": len(fit.frames),
        "absent": content["absent"],
        "residuals": medians,
        "problems": len(notes),
        "seen": {"cameras": list(observations.cameras), "frames": list(shape_frames)},
    }
    return Registration(fit, observations, content), StageOutput(registration_checks(observations, fit), numbers)


def stacked_rows(frames: Sequence[int], params: BodyParams) -> dict[str, Any]:
    """Return arrays whose row is the frame's number, NaN where there is no frame, as a capture reads them."""
    rows = max(frames) + 1
    arrays = params.as_dict()
    for name in ARRAY_NAMES:
        stacked = np.full((rows, arrays[name].shape[1]), np.nan)
        stacked[list(frames)] = arrays[name]
        arrays[name] = stacked
    return arrays | params.offsets_by_row(frames)


def by_camera(body: BodyModel, observed: Observations, fit: BodyFit) -> dict[str, dict[str, Any]]:
    """Measure the distance of keypoints to the fitted joints by camera: number, median and 90th percentile in pixels.

    Every keypoint with a confidence counts, whether the solver used it or not.
    """
    # Keep the order of first mention, so that columns are equal from run to run. Cameras may differ in their names.
    names = list(dict.fromkeys(name for found in observed.keypoints.values() for name in found.names))
    landmarks = LandmarkModel.of(body, names)
    # Rows of the initial parameters are those of the observed frames, not of the registered ones.
    at = {frame: row for row, frame in enumerate(observed.frames)}
    fits = {"after": _landmark_points(body, fit.params, landmarks)} if observed.keypoints else {}
    if fits and observed.initial is not None:
        start = observed.initial.select([at[frame] for frame in fit.frames])
        fits = {"before": _landmark_points(body, start, landmarks), **fits}
    out: dict[str, dict[str, Any]] = {}
    for name, keypoints in observed.keypoints.items():
        # (F, K) confidences and (F, K, 2) pixels; frames or landmarks that a camera lacks have a confidence of zero.
        seen = keypoints.select(landmarks.names, fit.frames)
        counted = seen.confidence > 0
        if counted.any():
            out[name] = {"points": int(counted.sum())}
            for when, points in fits.items():
                # World points to pixels; the third column, depth, is not needed.
                pixels = observed.cameras[name].screen_from_world(points.reshape(-1, 3))[:, :2]
                distance = np.linalg.norm(pixels.reshape(seen.points.shape) - seen.points, axis=-1)
                out[name][when] = _spread_of(distance[counted])
    return out


def _landmark_points(body: BodyModel, params: BodyParams, landmarks: LandmarkModel) -> Float64[np.ndarray, "F K 3"]:
    """Positions in the world of the points that keypoints mark on the body."""
    points = np.zeros((len(params), len(landmarks.names), 3))
    for row in range(len(params)):
        posed = body.forward(params.frame(row)).frame(0)
        points[row] = landmarks.points(posed.vertices, posed.joints)
    return points


def _spread_of(errors: np.ndarray) -> dict[str, float]:
    return {"median_px": float(np.median(errors)), "p90_px": float(np.percentile(errors, 90))}


def frame_confidence(confidence: Float64[np.ndarray, "F J"]) -> Float64[np.ndarray, " F"]:
    """Return the mean confidence of the body's joints in each frame."""
    return confidence[:, :BODY_JOINTS].mean(axis=1)


def registration_checks(observed: Observations, fit: BodyFit) -> list[Check]:
    """Check the medians of the residuals, and the shares of frames registered and observed."""
    # Median height in pixels over the cameras, 1 where there are none and no residual in pixels exists.
    height = float(np.median([camera.height for camera in observed.cameras.values()] or [1]))
    checks = []
    for name, residual in RESIDUALS.items():
        # NaN stands for a frame in which nothing of this kind was observed.
        values = np.asarray(fit.residuals.get(name, ()), dtype=np.float64)
        if residual.gate is None or not np.isfinite(values).any():
            continue
        scale = height if residual.unit == "px" else 1.0
        warn, fail = (round(bound * scale, 2) for bound in residual.gate)
        words = f"median over {int(np.isfinite(values).sum())} frames"
        if residual.unit == "px":
            words += (
                f"; the gate is {100 * residual.gate[0]:g} % and {100 * residual.gate[1]:g} % of the image's height"
            )
        value = float(np.nanmedian(values))
        checks.append(Check(residual.words, value, residual.unit, warn, fail, explanation=words))
    missing = [frame for frame in observed.frames if frame not in fit.frames]
    checks.append(
        Check(
            "share of frames registered",
            len(fit.frames) / len(observed.frames),
            "",
            1.0,
            0.9,
            higher_is_better=True,
            explanation=f"without frames {_few(missing)}" if missing else f"all {len(fit.frames)}",
        )
    )
    # A frame may have converged and still be the priors' guess, if all joints were hidden.
    means = frame_confidence(fit.confidence)
    doubtful = [frame for frame, mean in zip(fit.frames, means, strict=True) if mean < CONFIDENT]
    checks.append(
        Check(
            "share of frames with a confident fit",
            float(np.mean(means >= CONFIDENT)),
            "",
            0.95,
            0.5,
            higher_is_better=True,
            explanation=f"mean confidence of the body's joints below {CONFIDENT:g} in frames {_few(doubtful)}"
            if doubtful
            else f"mean confidence of the body's joints of {CONFIDENT:g} and more",
        )
    )
    return checks


def _few(frames: Sequence[int], count: int = 8) -> str:
    shown = ", ".join(map(str, frames[:count]))
    return shown if len(frames) <= count else f"{shown} and {len(frames) - count} more"


def summary(body: BodyModel, observed: Observations, fit: BodyFit, notes: Sequence[str]) -> dict[str, Any]:
    """Summarise a registration: residuals by frame before and after, reprojection by camera, notes under "problems"."""
    residuals: Mapping[str, Mapping[str, Any]] = {"after": fit.residuals, "before": fit.initial_residuals}
    return {
        "frames": list(fit.frames),
        "absent": [frame for frame in observed.frames if frame not in fit.frames],
        "held_out_frames": sorted(set(observed.frames) - set(observed.shape_frames or observed.frames)),
        "cameras": list(observed.cameras),
        "residuals": {
            when: {name: np.asarray(values, dtype=np.float64) for name, values in found.items()}
            for when, found in residuals.items()
        },
        "by_camera": by_camera(body, observed, fit),
        "confidence": frame_confidence(fit.confidence),
        "seen": {
            "keypoints": sorted(observed.keypoints),
            "masks": observed.mask is not None,
            "label_maps": observed.labels is not None,
            "landmarks": sum(len(points) for points in observed.landmarks.values()),
            "scans": {frame: scan.labels is not None for frame, scan in observed.scans.items()},
            "start": observed.initial is not None,
        },
        "problems": list(notes),
    }
