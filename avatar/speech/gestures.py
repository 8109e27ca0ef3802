"""The vocabulary of arms and hands of somebody who stands and talks: shapes, and pairs of them that go together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

MIRROR = np.array([1.0, -1.0, -1.0])
"""Times a rotation vector of the left side: that of the right side."""
ARM_JOINTS = ("shoulder", "elbow", "wrist")


@dataclass(frozen=True)
class Arm:
    """A shape of the left arm in degrees, from the T-pose; the right one is its mirror image.

    Attributes:
        down: how far the upper arm is lowered.
        forward: how far it then swings to the front.
        inward: turn about its own axis: a bent forearm goes before the body, below 0 to the outside.
        bend: of the elbow.
        palm: turn of the hand about the forearm.
        fingers: degrees a joint bends, of the index finger and of the others.
    """

    down: float
    forward: float
    inward: float
    bend: float
    palm: float = 0.0
    fingers: tuple[float, float] = (12.0, 16.0)

    @property
    def turns(self) -> Float64[np.ndarray, "3 3"]:
        """Rotation vectors of the left `ARM_JOINTS`, radians."""
        down, forward, inward, bend, palm = np.radians([self.down, self.forward, self.inward, self.bend, self.palm])

        def turn(axis: int, angle: float) -> Float64[np.ndarray, "3 3"]:
            return matrix_from_rotvec(angle * np.eye(3)[axis])

        shoulder = turn(0, -forward) @ turn(2, -down) @ turn(0, inward)
        return np.stack([rotvec_from_matrix(shoulder), [0.0, -bend, 0.0], [palm, 0.0, 0.0]])


ARMS = {
    "hanging": Arm(66, 3, 0, 14),
    "belly": Arm(68, 12, 20, 76, 10, (16.0, 22.0)),
    "front": Arm(68, 16, 4, 80, 20, (6.0, 8.0)),
    "offered": Arm(62, 12, -22, 68, -60, (4.0, 6.0)),
    "raised": Arm(60, 24, 6, 108, -10, (8.0, 14.0)),
    "chest": Arm(60, 25, 38, 110, 0, (10.0, 12.0)),
    "low": Arm(62, 12, 2, 44, 15, (14.0, 20.0)),
    "wide": Arm(46, 14, -10, 54, -35, (3.0, 4.0)),
    "counting": Arm(60, 26, 14, 100, 30, (2.0, 48.0)),
}
"""Shapes of an arm by name."""
_BOTH = ("belly", "front", "offered", "wide", "low", "raised")
_BESIDE = (
    *(("raised", "low"), ("belly", "offered"), ("front", "belly"), ("counting", "belly"), ("hanging", "chest")),
    *(("wide", "hanging"), ("raised", "hanging"), ("front", "hanging"), ("offered", "hanging"), ("offered", "low")),
    *(("wide", "low"), ("front", "offered"), ("raised", "belly"), ("chest", "low"), ("counting", "hanging")),
    *(("counting", "low"), ("raised", "offered"), ("front", "low"), ("wide", "belly")),
)
PAIRS = (*((name, name) for name in _BOTH), *_BESIDE, *((right, left) for left, right in _BESIDE))
"""What both arms do while one talks: the left arm's shape and the right one's."""
REST = ("hanging", "hanging")
