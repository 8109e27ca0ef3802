"""Points of the body that are known in space, as those placed by hand on a scan: residuals in metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.body import BodyModel
from smplxpp.register.keypoint_faults import other_side
from smplxpp.register.keypoint_term import carried_points
from smplxpp.register.kinematics import Kinematics, Posture
from smplxpp.register.landmarks import LandmarkModel
from smplxpp.register.normal_equations import NormalEquations
from smplxpp.register.robust import geman_mcclure
from smplxpp.register.sides import sides_are_exchanged

# Beyond this many deviations a landmark counts less and less (Geman and McClure).
_CUTOFF = 3.0
# Nobody sees a joint's centre: within a limb a hand is so many times less sure than on the skin.
_WITHIN = 3.0
# Metres: a landmark that the body keeps farther away than this, and than so many deviations, is named.
_FAR, _FAR_DEVIATIONS = 0.03, 3.0

PlacedPoints = Mapping[int, Mapping[str, Float[np.ndarray, " 3"]]]
"""Points by frame and name."""


@dataclass(frozen=True, eq=False)
class PlacedLandmarks:
    """Landmarks of T frames as a table.

    Attributes:
        landmarks: what the names are on the body.
        points: world, metres; NaN where a frame has none.
        problems: what was wrong with them, in words.
    """

    landmarks: LandmarkModel
    points: Float64[np.ndarray, "T K 3"]
    problems: tuple[str, ...] = ()

    @staticmethod
    def of(body: BodyModel, placed: PlacedPoints, frames: Sequence[int]) -> PlacedLandmarks | None:
        """Those of the frames that the body has; None without any.

        Where feet or face would point backwards, left and right were taken for each other, and are exchanged back.
        """
        found = PlacedLandmarks._table(body, placed, frames)
        if found is None or not sides_are_exchanged(found.landmarks.names, found.points):
            return found
        turned = {frame: {other_side(name): point for name, point in one.items()} for frame, one in placed.items()}
        mended = PlacedLandmarks._table(body, turned, frames)
        assert mended is not None  # a body has both sides of what it has
        words = (
            "left and right of the landmarks are exchanged: feet or face would point backwards; exchanged back "
            "(left is the person's left)"
        )
        return PlacedLandmarks(mended.landmarks, mended.points, (*mended.problems, words))

    @staticmethod
    def _table(body: BodyModel, placed: PlacedPoints, frames: Sequence[int]) -> PlacedLandmarks | None:
        asked = tuple(dict.fromkeys(name for frame in frames for name in placed.get(frame, {})))
        landmarks = LandmarkModel.of(body, asked)
        problems: tuple[str, ...] = ()
        if landmarks.unknown:
            shown = ", ".join(landmarks.unknown[:8]) + (", ..." if len(landmarks.unknown) > 8 else "")
            problems = (f"landmarks that the body {body.name!r} does not have are left out: {shown}",)
        if not landmarks.names:
            return None
        points = np.full((len(frames), len(landmarks.names), 3), np.nan)
        for row, frame in enumerate(frames):
            for k, name in enumerate(landmarks.names):
                if name in placed.get(frame, {}):
                    points[row, k] = placed[frame][name]
        return PlacedLandmarks(landmarks, points, problems)

    def of_rows(self, rows: np.ndarray) -> PlacedLandmarks:
        """Those of some of the frames."""
        return PlacedLandmarks(self.landmarks, self.points[rows], self.problems)


class LandmarkTerm:
    """`sum_k w |x_k - p_k|^2 / s_k^2`, robust; s is three times as large for what lies within a limb.

    Args:
        placed: of the frames of the registration.
        sigma: standard deviation of a landmark on the skin, metres.
    """

    def __init__(self, body: BodyModel, placed: PlacedLandmarks, sigma: float) -> None:
        self.names, self.points = placed.landmarks.names, placed.points
        self.carried, self.mixing = carried_points(body, placed.landmarks)
        within = (placed.landmarks.joint_index >= 0) | [name.startswith("coco_") for name in self.names]
        self.sigma = sigma * np.where(within, _WITHIN, 1.0)
        self.scale = 1.0

    def add(
        self, equations: NormalEquations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool
    ) -> None:
        """Add the landmarks of a frame."""
        there = np.flatnonzero(np.isfinite(self.points[row]).all(axis=1))
        if not len(there):
            return
        motion = kinematics.motion(self.carried, posture)
        residual = (self.mixing @ motion.points)[there] - self.points[row, there]
        sigma = self.scale * self.sigma[there]
        weight = np.sqrt(geman_mcclure(np.linalg.norm(residual, axis=1), _CUTOFF * sigma)) / sigma
        jacobian = equations.columns.jacobian(motion)
        rows = np.asarray(self.mixing @ jacobian.reshape(len(jacobian), -1)).reshape(-1, *jacobian.shape[1:])[there]
        scaled = weight[:, None, None] * rows
        equations.add(row, scaled.reshape(-1, scaled.shape[-1]), (weight[:, None] * residual).reshape(-1), shape=shape)

    def distances(self, row: int, kinematics: Kinematics, posture: Posture) -> Float64[np.ndarray, " K"]:
        """How far the body's points are from those of a frame, metres; NaN where it has none."""
        return np.linalg.norm(self.mixing @ kinematics.points(self.carried, posture) - self.points[row], axis=1)

    def far(self, distances: Float64[np.ndarray, " K"]) -> list[str]:
        """The names, with their distances, of landmarks that the body did not come to."""
        far = np.flatnonzero(distances > np.maximum(_FAR, _FAR_DEVIATIONS * self.sigma))
        return [f"{self.names[k]} ({1e3 * distances[k]:.0f} mm)" for k in far]
