"""Limit poses to the range of the training: the largest angle of each joint from its mean rotation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix

MARGIN = np.radians(10.0)
"""Largest angle in radians outside of the training that still counts as inside its range."""


@dataclass(frozen=True, eq=False)
class PoseRange:
    """The range of the body joints' rotations in training.

    Attributes:
        middle: mean rotation of each joint.
        reach: largest angle from the mean, with `MARGIN`, radians.
    """

    middle: Float64[np.ndarray, "21 3 3"]
    reach: Float64[np.ndarray, " 21"]

    @staticmethod
    def of(known: Float[np.ndarray, "K 63"]) -> PoseRange:
        """Return the range of the training poses, of which there is at least one."""
        rotations = matrix_from_rotvec(np.asarray(known, np.float64).reshape(-1, 21, 3))
        # The chordal mean: the rotation nearest to the mean of the matrices.
        u, _, vt = np.linalg.svd(rotations.mean(axis=0))
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        middle = u @ vt
        reach = np.linalg.norm(rotvec_from_matrix(np.swapaxes(middle, 1, 2) @ rotations), axis=2).max(axis=0)
        return PoseRange(middle, reach + MARGIN)

    def outside(self, params: BodyParams) -> Bool[np.ndarray, "T 21"]:
        """Return which joints exceed the range of the training in each frame."""
        return np.linalg.norm(self._from_middle(params), axis=2) > self.reach

    def clamped(self, params: BodyParams) -> BodyParams:
        """Return the motion with joints outside the range rotated back to its border; others are unchanged."""
        away = self._from_middle(params)
        angle = np.linalg.norm(away, axis=2)
        too_far: Int64[np.ndarray, "n 2"] = np.argwhere(angle > self.reach)
        theta = np.array(params.body_pose).reshape(-1, 21, 3)
        for frame, joint in too_far:
            # Slightly less than the border, so that rounding does not leave it outside.
            held = away[frame, joint] * ((1.0 - 1e-9) * self.reach[joint] / angle[frame, joint])
            theta[frame, joint] = rotvec_from_matrix(self.middle[joint] @ matrix_from_rotvec(held))
        return replace(params, body_pose=theta.reshape(len(params), -1))

    def _from_middle(self, params: BodyParams) -> Float64[np.ndarray, "T 21 3"]:
        """Return the rotation vector from the mean to each joint's rotation."""
        rotations = matrix_from_rotvec(np.asarray(params.body_pose).reshape(-1, 21, 3))
        return rotvec_from_matrix(np.swapaxes(self.middle, 1, 2) @ rotations)
