"""Gestures of a person in a synthetic capture who stands and talks, from the poses of the avatar's gesture lexicon."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatar.speech.gesture_lexicon import ARM_JOINTS, ARM_POSES, MIRROR, ArmPose
from pipelines.synth.motion import relaxed_pose
from smplxpp.body.layout import SMPLX_JOINTS

_SIZED = ("down", "forward", "inward", "bend", "palm")

# The gestures: pose of the left arm and of the right arm.
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
        for joint, turn in _arm_turns(ARM_POSES[name], ARM_POSES["hanging"], size).items():
            pose[SMPLX_JOINTS.index(f"{side}_{joint}")] = turn if side == "left" else turn * MIRROR
    return pose


def _arm_turns(arm: ArmPose, hanging: ArmPose, size: float) -> dict[str, Float[np.ndarray, " 3"]]:
    """Axis-angle turns of the left arm's joints, radians, by name without the side."""

    def sized(name: str) -> float:
        at_rest = float(getattr(hanging, name))
        return at_rest + size * (float(getattr(arm, name)) - at_rest)

    down, forward, inward, bend, palm = map(sized, _SIZED)
    out = dict(zip(ARM_JOINTS, ArmPose(down, forward, inward, bend, palm).rotations, strict=True))
    for finger in ("index", "middle", "ring", "pinky"):
        bend = np.radians(arm.fingers[0 if finger == "index" else 1])
        out |= {f"{finger}{k}": np.array([0.0, 0.0, -bend]) for k in (1, 2, 3)}
    return out
