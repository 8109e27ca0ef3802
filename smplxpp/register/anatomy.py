"""What is known of bodies before any is seen: how far joints turn and how they mostly do.

Ranges follow the clinical tables of joint motion (American Academy of Orthopaedic Surgeons, "Joint Motion: Method of
Measuring and Recording", 1965), widened where a turn of the model's joint stands for several of the real ones, as
components of the axis-angle vector in the T-pose's axes (x to the person's left, y up, z to the front). The spreads are
stated here, not learned from any data set: a zero-mean Gaussian around the T-pose with arms hanging far within it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import JOINT_NAMES

_FREE = 400.0
# Joint: spread a component, then lowest and highest a component, degrees, of the left side; the right side is mirrored
# (x stays, y and z change their sign). Unnamed joints are fingers.
_BODY: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "pelvis": ((_FREE,) * 3, (-_FREE,) * 3, (_FREE,) * 3),
    "spine1": ((12, 8, 8), (-25, -20, -20), (40, 20, 20)),
    "spine2": ((10, 8, 8), (-20, -20, -20), (35, 20, 20)),
    "spine3": ((10, 8, 8), (-20, -20, -20), (35, 20, 20)),
    "neck": ((15, 15, 12), (-45, -50, -35), (45, 50, 35)),
    "head": ((15, 20, 12), (-45, -60, -35), (45, 60, 35)),
    "left_collar": ((8, 12, 12), (-25, -30, -25), (25, 30, 45)),
    "left_shoulder": ((40, 45, 55), (-110, -140, -110), (110, 60, 110)),
    "left_elbow": ((35, 55, 12), (-95, -155, -45), (95, 10, 45)),
    "left_wrist": ((30, 20, 25), (-80, -45, -85), (80, 45, 85)),
    "left_hip": ((35, 20, 20), (-130, -60, -40), (40, 60, 65)),
    "left_knee": ((50, 10, 6), (-8, -35, -20), (155, 35, 20)),
    "left_ankle": ((18, 12, 12), (-35, -35, -35), (60, 35, 35)),
    "left_foot": ((10, 4, 4), (-60, -10, -10), (40, 10, 10)),
    "jaw": ((10, 3, 3), (-3, -12, -10), (35, 12, 10)),
    "left_eye_smplhf": ((12, 12, 2), (-35, -40, -5), (35, 40, 5)),
}
# Fingers of the left hand point along +x in the T-pose and bend down: -z. The right hand is mirrored.
_FINGER = ((6.0, 8.0, 28.0), (-20.0, -30.0, -115.0), (20.0, 30.0, 30.0))
_THUMB = ((18.0, 20.0, 20.0), (-60.0, -70.0, -70.0), (60.0, 70.0, 70.0))


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Spreads and bounds of every joint's axis-angle vector, radians.

    Attributes:
        spread: standard deviations. lowest, highest: bounds.
    """

    spread: Float64[np.ndarray, "J 3"]
    lowest: Float64[np.ndarray, "J 3"]
    highest: Float64[np.ndarray, "J 3"]

    @staticmethod
    def of(joint_count: int) -> Anatomy:
        """Of a body of the SMPL family, by its number of joints."""
        rows = [_of_joint(name) for name in JOINT_NAMES[joint_count]]
        return Anatomy(*(np.radians(np.array([row[k] for row in rows])) for k in range(3)))


def _of_joint(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    side, _, rest = name.partition("_")
    left = f"left_{rest}" if side == "right" else name
    finger = _THUMB if "thumb" in name else _FINGER
    spread, lowest, highest = (np.asarray(v, dtype=np.float64) for v in _BODY.get(left, finger))
    if side == "right":
        mirror = np.array([1.0, -1.0, -1.0])
        ends = np.stack([lowest * mirror, highest * mirror])
        lowest, highest = ends.min(axis=0), ends.max(axis=0)
    return spread, lowest, highest
