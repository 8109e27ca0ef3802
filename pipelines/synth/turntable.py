"""A person who turns once on the spot before a camera that stands still, with arms away from the body.

The pose is not held still while turning: the arms sway by some degrees, the weight shifts from foot to foot, the head
looks around. Poses of frames differ by this sway and by the heading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from pipelines.synth.motion import SeededMotion, relaxed_pose, wander
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix

# Standard deviation of each joint's sway about each axis, degrees.
_SWAY = {
    "spine1": 1.0,
    "spine2": 1.0,
    "neck": 2.0,
    "head": 3.0,
    "left_shoulder": 4.0,
    "right_shoulder": 4.0,
    "left_elbow": 4.0,
    "right_elbow": 4.0,
    "left_wrist": 4.0,
    "right_wrist": 4.0,
    "left_hip": 2.0,
    "right_hip": 2.0,
}
_LEAN_DEGREES, _DRIFT_M = 1.0, 0.03  # standard deviation of the trunk's lean, and of its place on the floor


@dataclass(frozen=True, eq=False)
class Turntable(SeededMotion):
    """One turn to the left within the duration, as a function of time; the face stays neutral."""

    feet_stay: ClassVar[bool] = False

    def at(self, times: Float[np.ndarray, " T"], *, fps: float | None = None) -> BodyParams:
        """Return the parameters at `times` in seconds; `fps` is stored as it is given."""
        turn_degrees = 345.0  # from the first frame to the last, which therefore do not show the same side
        t = self.instants(times)
        rng = np.random.default_rng([self.seed, 7])
        # The performance begins at rest, so that cloth starts settled; all sway grows within half a second.
        grown = (1.0 - np.exp(-((t / 0.5) ** 2)))[:, None]
        pose = np.repeat(relaxed_pose()[None], len(t), axis=0)
        for name, degrees in _SWAY.items():
            pose[:, SMPLX_JOINTS.index(name)] += np.radians(degrees) * grown * wander(t, rng, hertz=0.5)
        turn = np.radians(turn_degrees) * t / max(self.seconds, 1e-9)
        lean = np.radians(_LEAN_DEGREES) * grown * wander(t, rng, hertz=0.4)
        pose[:, 0] = _rotvec_about_y_then(turn, lean)
        drift = _DRIFT_M * grown * wander(t, rng, hertz=0.2)
        drift[:, 1] = 0.0
        return BodyParams.from_full_pose(
            pose,
            betas=np.repeat(self.betas[None], len(t), axis=0),
            expression=np.zeros((len(t), len(self.expression_names))),
            transl=drift,
            fps=fps,
        )


def _rotvec_about_y_then(turn: Float[np.ndarray, " T"], lean: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Return the rotation vectors of a turn about the vertical that is applied after a small lean."""
    upright = np.zeros((len(turn), 3))
    upright[:, 1] = turn
    return rotvec_from_matrix(matrix_from_rotvec(upright) @ matrix_from_rotvec(lean))
