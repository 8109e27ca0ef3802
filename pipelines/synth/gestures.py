"""The vocabulary of gestures of a person who stands and talks: shapes of arms and hands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipelines.synth.motion import relaxed_pose
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix


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
# The vocabulary: the left arm's shape and the right one's.
GESTURES = (
    ("hanging", "hanging"),
    ("belly", "belly"),
    ("front", "front"),
    ("offered", "offered"),
    ("wide", "wide"),
    ("raised", "low"),
    ("low", "raised"),
    ("belly", "offered"),
    ("front", "belly"),
    ("counting", "belly"),
    ("hanging", "chest"),
    ("wide", "hanging"),
)


def rounds(rng: np.random.Generator, count: int, least: int) -> list[int]:
    """Shuffled rounds of 0 .. count - 1, at least `least` numbers, none twice in succession."""
    out: list[int] = []
    while len(out) < least:
        some = rng.permutation(count).tolist()
        if out and some[0] == out[-1]:
            some = some[1:] + some[:1]
        out += some
    return out


def arms_pose(left: str, right: str, *, size: float) -> Float[np.ndarray, "55 3"]:
    """The relaxed pose with arms of the named shapes; of another `size` they go as much farther from hanging."""
    pose = relaxed_pose()
    for side, name in (("left", left), ("right", right)):
        for joint, turn in _arm_turns(ARMS[name], ARMS["hanging"], size).items():
            pose[SMPLX_JOINTS.index(f"{side}_{joint}")] = turn if side == "left" else turn * [1.0, -1.0, -1.0]
    return pose


def _arm_turns(arm: Arm, hanging: Arm, size: float) -> dict[str, Float[np.ndarray, " 3"]]:
    """Axis-angle turns of the left arm's joints, radians, by name without the side."""

    def sized(name: str) -> float:
        at_rest = float(getattr(hanging, name))
        return float(np.radians(at_rest + size * (getattr(arm, name) - at_rest)))

    def turn(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
        return matrix_from_rotvec(angle * np.eye(3)[axis])

    shoulder = turn(0, -sized("forward")) @ turn(2, -sized("down")) @ turn(0, sized("inward"))
    out = {
        "shoulder": rotvec_from_matrix(shoulder),
        "elbow": np.array([0.0, -sized("bend"), 0.0]),
        "wrist": np.array([sized("palm"), 0.0, 0.0]),
    }
    for finger in ("index", "middle", "ring", "pinky"):
        bend = np.radians(arm.fingers[0 if finger == "index" else 1])
        out |= {f"{finger}{k}": np.array([0.0, 0.0, -bend]) for k in (1, 2, 3)}
    return out
