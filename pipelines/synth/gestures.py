"""The vocabulary of gestures of a person of a capture who stands and talks, of the shapes that avatars talk with."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatar.speech.gestures import ARM_JOINTS, ARMS, MIRROR, Arm
from pipelines.synth.motion import relaxed_pose
from smplxpp.body.layout import SMPLX_JOINTS

_SIZED = ("down", "forward", "inward", "bend", "palm")

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
            pose[SMPLX_JOINTS.index(f"{side}_{joint}")] = turn if side == "left" else turn * MIRROR
    return pose


def _arm_turns(arm: Arm, hanging: Arm, size: float) -> dict[str, Float[np.ndarray, " 3"]]:
    """Axis-angle turns of the left arm's joints, radians, by name without the side."""

    def sized(name: str) -> float:
        at_rest = float(getattr(hanging, name))
        return at_rest + size * (float(getattr(arm, name)) - at_rest)

    down, forward, inward, bend, palm = map(sized, _SIZED)
    out = dict(zip(ARM_JOINTS, Arm(down, forward, inward, bend, palm).turns, strict=True))
    for finger in ("index", "middle", "ring", "pinky"):
        bend = np.radians(arm.fingers[0 if finger == "index" else 1])
        out |= {f"{finger}{k}": np.array([0.0, 0.0, -bend]) for k in (1, 2, 3)}
    return out
