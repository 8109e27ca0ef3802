"""Provide named poses: standing and rare poses of people who are scanned, and stress poses that test a template's skin.

Angles follow SMPL-X's T-pose (x to the person's left, y up, z to the front; joint frames are the world's axes).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import JOINT_NAMES, SMPLX_JOINTS
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix

MIRROR = np.array([1.0, -1.0, -1.0])
"""Factors that take a rotation vector of the left side to the mirrored one of the right side."""
ARM_JOINTS = ("shoulder", "elbow", "wrist")
_Rotations = Mapping[str, tuple[tuple[float, float, float], ...]]
# Rotation vectors of the left side's joints, degrees, of which the first is applied last; the right side is the mirror
# image. Arms of the T-pose point along x: a rotation about -z lowers them, about x twists them, about -y takes them
# forwards.
_ARMS: Mapping[str, _Rotations] = {
    "hanging": {"shoulder": ((0, 0, -76),), "elbow": ((0, -12, 0),)},
    "lowered": {"shoulder": ((0, 0, -48),)},
    "spread": {"shoulder": ((0, 0, -8),)},
    "raised": {"shoulder": ((0, 0, 68),)},
    "bent": {"shoulder": ((0, 0, -68),), "elbow": ((0, -80, 0),)},
    "on hips": {"shoulder": ((0, 0, -50), (70, 0, 0)), "elbow": ((0, -95, 0),)},
    "crossed": {"shoulder": ((0, -30, 0), (0, 0, -65), (50, 0, 0)), "elbow": ((0, -105, 0),)},
    "forwards": {"shoulder": ((0, -75, 0), (0, 0, -15))},
}
# Pairs of different left and right arms.
_ASYMMETRIC = (("hanging", "raised"), ("hanging", "bent"), ("hanging", "on hips"), ("hanging", "forwards"))
_LEGS: Mapping[str, tuple[_Rotations, _Rotations]] = {
    "apart": ({}, {}),
    "close": ({"hip": ((0, 0, -9),)}, {"hip": ((0, 0, -9),)}),
    "walking": (
        {"hip": ((-22, 0, 0), (0, 0, -8)), "knee": ((12, 0, 0),)},
        {"hip": ((12, 0, 0), (0, 0, -8)), "knee": ((20, 0, 0),)},
    ),
    "knees bent": (
        {"hip": ((-55, 0, 0),), "knee": ((75, 0, 0),), "ankle": ((-18, 0, 0),)},
        {"hip": ((-55, 0, 0),), "knee": ((75, 0, 0),), "ankle": ((-18, 0, 0),)},
    ),
}
# Legs and trunks of people who act, dance or do sports; the arms are those of `_RARE_ARMS`.
_STRAIGHT: _Rotations = {"hip": ((0, 0, -4),)}
_RARE: Mapping[str, tuple[_Rotations, _Rotations, _Rotations]] = {
    "a knee drawn up": ({"hip": ((-85, 0, 0),), "knee": ((90, 0, 0),), "ankle": ((15, 0, 0),)}, _STRAIGHT, {}),
    "a foot drawn up": ({"hip": ((-50, 0, 0),), "knee": ((105, 0, 0),), "ankle": ((15, 0, 0),)}, _STRAIGHT, {}),
    "kicking forwards": (
        {"hip": ((-75, 0, 0),), "knee": ((15, 0, 0),), "ankle": ((15, 0, 0),)},
        _STRAIGHT,
        {"pelvis": ((-10, 0, 0),)},
    ),
    "kicking sideways": ({"hip": ((0, 0, 50),), "knee": ((15, 0, 0),)}, _STRAIGHT, {"pelvis": ((0, 0, -8),)}),
    "kicking back": (
        {"hip": ((32, 0, 0),), "knee": ((55, 0, 0),), "ankle": ((15, 0, 0),)},
        _STRAIGHT,
        {"pelvis": ((12, 0, 0),)},
    ),
    "a deep step": (
        {"hip": ((-75, 0, 0),), "knee": ((85, 0, 0),)},
        {"hip": ((28, 0, 0),), "knee": ((35, 0, 0),), "ankle": ((-15, 0, 0),)},
        {},
    ),
    "sitting on nothing": (
        {"hip": ((-85, 0, 4),), "knee": ((92, 0, 0),), "ankle": ((-12, 0, 0),)},
        {"hip": ((-85, 0, 4),), "knee": ((92, 0, 0),), "ankle": ((-12, 0, 0),)},
        {"pelvis": ((10, 0, 0),), "spine1": ((10, 0, 0),), "spine2": ((6, 0, 0),)},
    ),
    "bent": (
        {"hip": ((-12, 0, -4),), "knee": ((6, 0, 0),)},
        {"hip": ((-12, 0, -4),), "knee": ((6, 0, 0),)},
        {"pelvis": ((12, 0, 0),), "spine1": ((18, 0, 0),), "spine2": ((16, 0, 0),), "spine3": ((10, 0, 0),)},
    ),
    "bent deeply": (
        {"hip": ((-24, 0, -4),), "knee": ((8, 0, 0),)},
        {"hip": ((-24, 0, -4),), "knee": ((8, 0, 0),)},
        {"pelvis": ((24, 0, 0),), "spine1": ((28, 0, 0),), "spine2": ((25, 0, 0),), "spine3": ((15, 0, 0),)},
    ),
}
_RARE_ARMS = ("lowered", "spread", "raised", "forwards")
# Legs of people near the floor, the left one and its mirror image: kneeling upright, on the heels, squatting, and
# sitting with legs stretched out, drawn up or crossed.
_LOW: Mapping[str, _Rotations] = {
    "kneeling": {"hip": ((-3, 0, 5),), "knee": ((92, 0, 0),), "ankle": ((38, 0, 0),)},
    "on the heels": {"hip": ((-62, 0, 8),), "knee": ((148, 0, 0),), "ankle": ((45, 0, 0),)},
    "squatting": {"hip": ((-105, 0, 14),), "knee": ((122, 0, 0),), "ankle": ((-20, 0, 0),)},
    "legs stretched out": {"hip": ((-88, 0, 6),), "knee": ((8, 0, 0),)},
    "legs drawn up": {"hip": ((-102, 0, 5),), "knee": ((112, 0, 0),)},
    "legs crossed": {"hip": ((0, 40, 0), (-82, 0, 0), (0, 60, 0)), "knee": ((122, 0, 0),)},
}


def standing_poses(joint_count: int) -> Iterator[tuple[str, Float64[np.ndarray, "J 3"]]]:
    """Yield names and axis-angle vectors, radians, of poses in which people stand while they are scanned.

    Args:
        joint_count: of a body of the SMPL family; its pelvis is not rotated.
    """
    arms = [(name, name) for name in _ARMS] + [*_ASYMMETRIC, *((b, a) for a, b in _ASYMMETRIC)]
    for left, right in arms:
        for name, (one, other) in _LEGS.items():
            title = f"arms {left}, legs {name}" if left == right else f"left arm {left}, right {right}, legs {name}"
            yield title, _pose_of(joint_count, _ARMS[left], _ARMS[right], one, other)
            if one != other:
                yield f"{title}, the other way", _pose_of(joint_count, _ARMS[left], _ARMS[right], other, one)


def rare_poses(joint_count: int) -> Iterator[tuple[str, Float64[np.ndarray, "J 3"]]]:
    """Yield names and axis-angle vectors, radians, of poses that few scans show: a leg drawn up or kicked, a deep step,
    sitting on nothing, a bent trunk.

    Args:
        joint_count: of a body of the SMPL family.

    Example:
        >>> from smplxpp.body.named_poses import rare_poses
        >>> name, vectors = next(rare_poses(55))
        >>> name, vectors.shape
        ('a knee drawn up, arms lowered', (55, 3))
    """
    for arm in _RARE_ARMS:
        for name, (one, other, trunk) in _RARE.items():
            yield f"{name}, arms {arm}", _pose_of(joint_count, _ARMS[arm], _ARMS[arm], one, other, trunk=trunk)
            if one != other:
                # A trunk that leans to a side leans to the other one.
                turned = {k: tuple((x, -y, -z) for x, y, z in v) for k, v in trunk.items()}
                yield (
                    f"{name}, arms {arm}, the other way",
                    _pose_of(joint_count, _ARMS[arm], _ARMS[arm], other, one, trunk=turned),
                )


def low_poses(joint_count: int) -> Iterator[tuple[str, Float64[np.ndarray, "J 3"]]]:
    """Yield names and axis-angle vectors, radians, of poses of people who kneel, squat or sit on the floor.

    Args:
        joint_count: of a body of the SMPL family.
    """
    for arm in ("hanging", "forwards"):
        for name, legs in _LOW.items():
            yield f"{name}, arms {arm}", _pose_of(joint_count, _ARMS[arm], _ARMS[arm], legs, legs)


def _pose_of(joint_count: int, *parts: _Rotations, trunk: _Rotations | None = None) -> Float64[np.ndarray, "J 3"]:
    """Return the axis-angle vectors of left arm, right arm, left leg, right leg and trunk, other joints at rest."""
    place = {name: k for k, name in enumerate(JOINT_NAMES[joint_count])}
    out = np.tile(np.eye(3), (joint_count, 1, 1))
    for side, rotations in zip(("left", "right", "left", "right"), parts, strict=True):
        for joint, vectors in rotations.items():
            for vector in vectors:
                degrees = np.array(vector, dtype=np.float64) * (1.0 if side == "left" else MIRROR)
                k = place[f"{side}_{joint}"]
                out[k] = out[k] @ matrix_from_rotvec(np.radians(degrees))
    for joint, vectors in (trunk or {}).items():
        for vector in vectors:
            out[place[joint]] = out[place[joint]] @ matrix_from_rotvec(np.radians(np.array(vector, dtype=np.float64)))
    return rotvec_from_matrix(out)


# Axis-angle vectors of joints, degrees. Each pose bends what is hard for clothes to follow.
STRESS_POSES: dict[str, dict[str, tuple[float, float, float]]] = {
    "squat": {
        "left_hip": (-95, 0, 15),
        "right_hip": (-95, 0, -15),
        "left_knee": (110, 0, 0),
        "right_knee": (110, 0, 0),
        "left_ankle": (-25, 0, 0),
        "right_ankle": (-25, 0, 0),
        "spine1": (15, 0, 0),
        "spine2": (10, 0, 0),
        "left_shoulder": (0, -60, -20),
        "right_shoulder": (0, 60, 20),
    },
    "high_step": {
        "left_hip": (-90, 0, 5),
        "left_knee": (95, 0, 0),
        "right_hip": (10, 0, 0),
        "left_shoulder": (0, 0, -60),
        "right_shoulder": (0, 0, 60),
        "right_elbow": (0, 60, 0),
    },
    "arms_overhead": {
        "left_collar": (0, 0, 20),
        "right_collar": (0, 0, -20),
        "left_shoulder": (0, 0, 60),
        "right_shoulder": (0, 0, -60),
        "left_elbow": (0, 0, 10),
        "right_elbow": (0, 0, -10),
    },
    "twist": {
        "spine1": (0, 15, 0),
        "spine2": (0, 20, 0),
        "spine3": (0, 15, 0),
        "neck": (0, 15, 0),
        "head": (0, 20, 0),
        "left_shoulder": (0, 0, -65),
        "right_shoulder": (0, 0, 65),
    },
}


# What clothes are for: poses of every day, each of which shows a garment that follows the wrong limb.
WORN_POSES: dict[str, dict[str, tuple[float, float, float]]] = {
    "walk": {
        "left_hip": (-30, 0, 0),
        "left_knee": (15, 0, 0),
        "right_hip": (22, 0, 0),
        "right_knee": (30, 0, 0),
        "left_shoulder": (0, 20, -68),
        "right_shoulder": (0, 20, 68),
    },
    "sit": {
        "left_hip": (-88, 0, 6),
        "right_hip": (-88, 0, -6),
        "left_knee": (90, 0, 0),
        "right_knee": (90, 0, 0),
        "left_shoulder": (0, 0, -60),
        "right_shoulder": (0, 0, 60),
    },
    "reach": {
        "left_collar": (0, 0, 15),
        "left_shoulder": (0, -20, 60),
        "right_shoulder": (0, 70, 10),
        "spine2": (10, 10, 0),
    },
    "twist": STRESS_POSES["twist"],
}


def stress_poses(reference: BodyParams) -> BodyParams:
    """Return the poses of `STRESS_POSES`, in order, with the shape and translation of the reference's first frame.

    Args:
        reference: the person; only the first frame is used.

    Returns:
        BodyParams of `len(STRESS_POSES)` frames with a neutral face and hands at rest (zero).
    """
    return _posed(reference, STRESS_POSES)


def worn_poses(reference: BodyParams) -> BodyParams:
    """Return the poses of `WORN_POSES` as `stress_poses` does."""
    return _posed(reference, WORN_POSES)


def _posed(reference: BodyParams, poses: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> BodyParams:
    """Return named poses with the shape and translation of the reference's first frame."""
    first = reference.frame(0)
    count = len(poses)
    # Axis-angle vectors of all joints of SMPL-X in radians; joints that a pose does not name stay at rest.
    pose = np.zeros((count, 55, 3))
    for row, joints in enumerate(poses.values()):
        for joint, degrees in joints.items():
            pose[row, SMPLX_JOINTS.index(joint)] = np.radians(degrees)
    return BodyParams.from_full_pose(
        pose,
        betas=np.repeat(first.betas, count, axis=0),
        expression=np.zeros((count, first.expression.shape[1])),
        transl=np.repeat(first.transl, count, axis=0),
    )


@dataclass(frozen=True)
class ArmPose:
    """A pose of the left arm in degrees, from the T-pose; the right arm's is its mirror image.

    Attributes:
        down: lowering of the upper arm.
        forward: its swing to the front after that.
        inward: rotation about its own axis; positive values bring a bent forearm before the body.
        bend: flexion of the elbow.
        palm: rotation of the hand about the forearm.
        fingers: flexion a joint, of the index finger and of the other fingers.
    """

    down: float
    forward: float
    inward: float
    bend: float
    palm: float = 0.0
    fingers: tuple[float, float] = (12.0, 16.0)

    @property
    def rotations(self) -> Float64[np.ndarray, "3 3"]:
        """Rotation vectors of the left `ARM_JOINTS`, radians."""
        down, forward, inward, bend, palm = np.radians([self.down, self.forward, self.inward, self.bend, self.palm])

        def rotation(axis: int, angle: float) -> Float64[np.ndarray, "3 3"]:
            return matrix_from_rotvec(angle * np.eye(3)[axis])

        # From right to left: about the arm's own axis x, down about z, then to the front about x of the body.
        shoulder = rotation(0, -forward) @ rotation(2, -down) @ rotation(0, inward)
        return np.stack([rotvec_from_matrix(shoulder), [0.0, -bend, 0.0], [palm, 0.0, 0.0]])


ARM_POSES = {
    "hanging": ArmPose(66, 3, 0, 14),
    "belly": ArmPose(68, 12, 20, 76, 10, (16.0, 22.0)),
    "front": ArmPose(68, 16, 4, 80, 20, (6.0, 8.0)),
    "offered": ArmPose(62, 12, -22, 68, -60, (4.0, 6.0)),
    "raised": ArmPose(60, 24, 6, 108, -10, (8.0, 14.0)),
    "chest": ArmPose(60, 25, 38, 110, 0, (10.0, 12.0)),
    "low": ArmPose(62, 12, 2, 44, 15, (14.0, 20.0)),
    "wide": ArmPose(46, 14, -10, 54, -35, (3.0, 4.0)),
    "counting": ArmPose(60, 26, 14, 100, 30, (2.0, 48.0)),
}
"""Poses of an arm by name."""
