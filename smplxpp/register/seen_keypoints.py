"""Keypoints ready to be fitted: known to the body, agreed on by the views, with their noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.register.config import RegisterConfig
from smplxpp.register.landmarks import LandmarkModel
from smplxpp.register.observations import Observations
from smplxpp.register.sides import exchanged, sides_are_exchanged
from smplxpp.register.triangulate import Reprojection, triangulate

# Of a single camera nothing can be measured: pixels of noise for an image 640 high.
_ALONE_PX, _HEIGHT = 3.0, 640.0


@dataclass(frozen=True, eq=False)
class SeenKeypoints:
    """What a registration fits.

    Attributes:
        landmarks: what the names are on the body.
        keypoints: by camera, with the names of `landmarks` and all frames; what the views do not agree on has
            confidence 0.
        noise_px: of each camera.
        points: triangulated, NaN where they are not.
        reprojection: of each camera. problems: what was wrong, in words.
    """

    landmarks: LandmarkModel
    keypoints: Mapping[str, Keypoints2D]
    noise_px: Mapping[str, float]
    points: Float64[np.ndarray, "T K 3"]
    reprojection: Mapping[str, Reprojection] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


def see_keypoints(body: BodyModel, observed: Observations, config: RegisterConfig) -> SeenKeypoints | None:
    """Triangulate the keypoints and leave out what the views contradict; None where there are none."""
    given = {name: k for name, k in observed.keypoints.items() if name in observed.cameras}
    if not given:
        return None
    asked = tuple(dict.fromkeys(name for k in given.values() for name in k.names))
    landmarks = LandmarkModel.of(body, asked)
    problems = []
    if landmarks.unknown:
        shown = ", ".join(landmarks.unknown[:8]) + (", ..." if len(landmarks.unknown) > 8 else "")
        problems.append(f"keypoints that the body {body.name!r} does not have are left out: {shown}")
    frames, names = observed.frames, landmarks.names
    floor = {name: config.keypoint_px * observed.cameras[name].height / _HEIGHT for name in given}
    if len(given) < 2:
        keypoints = {name: k.select(names, frames) for name, k in given.items()}
        noise = {name: max(floor[name], _ALONE_PX * observed.cameras[name].height / _HEIGHT) for name in given}
        nothing = np.full((len(frames), len(names), 3), np.nan)
        return SeenKeypoints(landmarks, keypoints, noise, nothing, problems=tuple(problems))
    found = triangulate(given, observed.cameras, names=names, frames=frames)
    if sides_are_exchanged(found.names, found.points):
        problems.append(
            "left and right are exchanged in all views: feet and face would point backwards; exchanged back"
        )
        found = triangulate(exchanged(given), observed.cameras, names=names, frames=frames)
    agreed = {}
    known = np.isfinite(found.points).all(axis=2)
    for k, name in enumerate(found.cameras):
        if name in found.keypoints:
            one = found.keypoints[name]
            confidence = np.where(known & ~found.inliers[..., k], 0.0, one.confidence)
            agreed[name] = Keypoints2D(one.names, one.frames, one.points, confidence)
    return SeenKeypoints(
        landmarks,
        agreed,
        {name: max(floor[name], found.noise_px[name]) for name in agreed},
        found.points,
        found.by_camera,
        (*problems, *found.problems),
    )
