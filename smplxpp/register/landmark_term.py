"""Add points of the body that are known in space, such as landmarks placed by hand on a scan, as residuals in metres.

The term of a frame is `sum_k GM(|x_k - p_k|; 3 s_k) / s_k^2` over landmarks k, with the body's point x_k, the placed
point p_k, and GM the kernel of Geman and McClure. The standard deviation s_k of a point inside a limb is three times
that of a point on the skin, because a joint's centre cannot be seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.body import BodyModel
from smplxpp.register.keypoint_faults import other_side, sides_are_exchanged
from smplxpp.register.kinematics import Kinematics, Posture
from smplxpp.register.landmarks import LandmarkModel, LandmarkPoints
from smplxpp.register.normal_equations import Equations, geman_mcclure

PlacedPoints = Mapping[int, Mapping[str, Float[np.ndarray, " 3"]]]
"""Points in world coordinates, metres, by frame and name."""


@dataclass(frozen=True, eq=False)
class PlacedLandmarks:
    """A table of the landmarks that were placed in T frames.

    Attributes:
        landmarks: the named points of the body.
        points: in world coordinates, metres; NaN where a frame has none.
        notes: sentences about faults and what was done about them.
    """

    landmarks: LandmarkModel
    points: Float64[np.ndarray, "T K 3"]
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(body: BodyModel, placed: PlacedPoints, frames: Sequence[int]) -> PlacedLandmarks | None:
        """Collect the landmarks that the body has; None if there are none.

        Left and right are exchanged back where feet or face would point backwards.
        """
        found = PlacedLandmarks._table(body, placed, frames)
        if found is None or not sides_are_exchanged(found.landmarks.names, found.points):
            return found
        turned = {frame: {other_side(name): point for name, point in one.items()} for frame, one in placed.items()}
        mended = PlacedLandmarks._table(body, turned, frames)
        assert mended is not None  # a body has both sides of what it has
        note = (
            "left and right of the landmarks are exchanged: feet or face would point backwards; exchanged back "
            "(left is the person's left)"
        )
        return PlacedLandmarks(mended.landmarks, mended.points, (*mended.notes, note))

    @staticmethod
    def _table(body: BodyModel, placed: PlacedPoints, frames: Sequence[int]) -> PlacedLandmarks | None:
        asked = tuple(dict.fromkeys(name for frame in frames for name in placed.get(frame, {})))
        landmarks = LandmarkModel.of(body, asked)
        notes: tuple[str, ...] = ()
        if landmarks.unknown:
            shown = ", ".join(landmarks.unknown[:8]) + (", ..." if len(landmarks.unknown) > 8 else "")
            notes = (f"landmarks that the body {body.name!r} does not have are left out: {shown}",)
        if not landmarks.names:
            return None
        # One table over frames and names; NaN marks points that were not placed in a frame.
        points = np.full((len(frames), len(landmarks.names), 3), np.nan)
        for row, frame in enumerate(frames):
            for k, name in enumerate(landmarks.names):
                if name in placed.get(frame, {}):
                    points[row, k] = placed[frame][name]
        return PlacedLandmarks(landmarks, points, notes)

    def of_rows(self, rows: np.ndarray) -> PlacedLandmarks:
        """Return the landmarks of some of the frames."""
        return PlacedLandmarks(self.landmarks, self.points[rows], self.notes)


class LandmarkTerm:
    """Distances of landmarks; see the module's docstring.

    Args:
        body: the body model.
        placed: landmarks of the frames of the registration.
        sigma: standard deviation of a landmark on the skin, metres.
    """

    cutoff = 3.0
    """Standard deviations at which the robust weight is a quarter, and beyond which a landmark is reported."""

    def __init__(self, body: BodyModel, placed: PlacedLandmarks, sigma: float) -> None:
        self.names, self.points = placed.landmarks.names, placed.points
        self.landmarks = LandmarkPoints.of(body, placed.landmarks)
        # Joints and the COCO points, which name joints, lie inside limbs, where a person who places them can only guess
        # depth.
        within = (placed.landmarks.joint_index >= 0) | [name.startswith("coco_") for name in self.names]
        self.sigma = sigma * np.where(within, 3.0, 1.0)
        self.scale = 1.0

    def add(self, equations: Equations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool) -> None:
        """Add the landmarks of one frame to the normal equations."""
        there = np.flatnonzero(np.isfinite(self.points[row]).all(axis=1))
        if not len(there):
            return
        motion, points = self.landmarks.motion(kinematics, posture)
        residual = points[there] - self.points[row, there]
        sigma = self.scale * self.sigma[there]
        # Residual and Jacobian are scaled by the root of the robust weight over sigma, so that their square is GM r^2 /
        # s^2.
        weight = np.sqrt(geman_mcclure(np.linalg.norm(residual, axis=1), self.cutoff * sigma)) / sigma
        scaled = weight[:, None, None] * self.landmarks.combined(equations.columns.jacobian(motion))[there]
        equations.add(row, scaled.reshape(-1, scaled.shape[-1]), (weight[:, None] * residual).reshape(-1), shape=shape)

    def distances(self, row: int, kinematics: Kinematics, posture: Posture) -> Float64[np.ndarray, " K"]:
        """Return the distances of the body's points to the landmarks of a frame, metres; NaN where it has none."""
        return np.linalg.norm(self.landmarks.points(kinematics, posture) - self.points[row], axis=1)

    def far(self, distances: Float64[np.ndarray, " K"]) -> list[str]:
        """Return names and distances of landmarks that the body misses by over 3 cm and over three deviations."""
        far = np.flatnonzero(distances > np.maximum(0.03, self.cutoff * self.sigma))
        return [f"{self.names[k]} ({1e3 * distances[k]:.0f} mm)" for k in far]
