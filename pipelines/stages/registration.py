"""A registration in numbers: files that others read, gates, and how far keypoints are from the fitted joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core.checks import Check
from smplxpp.core.params import ARRAY_NAMES, BodyParams
from smplxpp.register import BodyFit, LandmarkModel, Observations

CONFIDENT = 0.5
"""Mean confidence of the body's joints from which a frame counts as seen, not guessed by the priors."""
BODY_JOINTS = 22
"""Joints that a frame's confidence is the mean of: without face and fingers."""


@dataclass(frozen=True)
class Residual:
    """How a residual is shown and gated.

    Attributes:
        words: what it is. unit: of its numbers.
        gate: where the median over frames passes and where it fails; of pixels, shares of the images' height.
    """

    words: str
    unit: str
    gate: tuple[float, float] | None = None


RESIDUALS: dict[str, Residual] = {
    "keypoints_px": Residual("keypoints to the body", "px", (0.01, 0.03)),
    "landmarks_mm": Residual("landmarks to the body", "mm", (20.0, 50.0)),
    "silhouette_px": Residual("silhouette to the mask", "px"),
    "skin_mm": Residual("bare skin to the scan", "mm", (8.0, 20.0)),
    "inside_mm": Residual("cloth of the scan inside the body", "mm", (5.0, 15.0)),
    "surface_mm": Residual("scan to the body", "mm"),
}
"""Those that have a gate and words of their own; others are shown by their name."""


def stacked_rows(frames: Sequence[int], params: BodyParams) -> dict[str, Any]:
    """Arrays whose row is the frame's number, NaN where there is no frame, as a capture reads them."""
    rows = max(frames) + 1
    arrays = params.as_dict()
    for name in ARRAY_NAMES:
        stacked = np.full((rows, arrays[name].shape[1]), np.nan)
        stacked[list(frames)] = arrays[name]
        arrays[name] = stacked
    return arrays | params.offsets_by_row(frames)


def by_camera(body: BodyModel, observed: Observations, fit: BodyFit) -> dict[str, dict[str, Any]]:
    """Number of keypoints, and median and 90th percentile of their distance in pixels, before and after, by camera.

    Every keypoint with a confidence counts, whether the solver believed it or not.
    """
    names = list(dict.fromkeys(name for found in observed.keypoints.values() for name in found.names))
    landmarks = LandmarkModel.of(body, names)
    at = {frame: row for row, frame in enumerate(observed.frames)}
    fits = {"after": _landmark_points(body, fit.params, landmarks)} if observed.keypoints else {}
    if fits and observed.initial is not None:
        start = observed.initial.select([at[frame] for frame in fit.frames])
        fits = {"before": _landmark_points(body, start, landmarks), **fits}
    out: dict[str, dict[str, Any]] = {}
    for name, keypoints in observed.keypoints.items():
        seen = keypoints.select(landmarks.names, fit.frames)
        counted = seen.confidence > 0
        if counted.any():
            out[name] = {"points": int(counted.sum())}
            for when, points in fits.items():
                pixels = observed.cameras[name].screen_from_world(points.reshape(-1, 3))[:, :2]
                distance = np.linalg.norm(pixels.reshape(seen.points.shape) - seen.points, axis=-1)
                out[name][when] = _spread_of(distance[counted])
    return out


def _landmark_points(body: BodyModel, params: BodyParams, landmarks: LandmarkModel) -> Float64[np.ndarray, "F K 3"]:
    """Where the points that keypoints mark are on the body, world."""
    points = np.zeros((len(params), len(landmarks.names), 3))
    for row in range(len(params)):
        posed = body.forward(params.frame(row)).frame(0)
        points[row] = landmarks.points(posed.vertices, posed.joints)
    return points


def _spread_of(errors: np.ndarray) -> dict[str, float]:
    return {"median_px": float(np.median(errors)), "p90_px": float(np.percentile(errors, 90))}


def frame_confidence(confidence: Float64[np.ndarray, "F J"]) -> Float64[np.ndarray, " F"]:
    """The mean confidence of the body's joints in each frame."""
    return confidence[:, :BODY_JOINTS].mean(axis=1)


def registration_checks(observed: Observations, fit: BodyFit) -> list[Check]:
    """Gates of a registration."""
    height = float(np.median([camera.height for camera in observed.cameras.values()] or [1]))
    checks = []
    for name, residual in RESIDUALS.items():
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


def summary(body: BodyModel, observed: Observations, fit: BodyFit, problems: Sequence[str]) -> dict[str, Any]:
    """What `registration.json` says: residuals by frame before and after, reprojection by camera, problems."""
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
        "problems": list(problems),
    }
