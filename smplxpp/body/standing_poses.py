"""Poses that people stand in while they are scanned: what a bare surface is compared with first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

_Turns = Mapping[str, tuple[tuple[float, float, float], ...]]
# Turns of the left side's joints, degrees, the first applied last; the right side is the mirror image. Arms of the
# T-pose point along x: a turn about -z lowers them, about x twists them, about -y takes them forwards.
_ARMS: Mapping[str, _Turns] = {
    "hanging": {"shoulder": ((0, 0, -76),), "elbow": ((0, -12, 0),)},
    "lowered": {"shoulder": ((0, 0, -48),)},
    "spread": {"shoulder": ((0, 0, -8),)},
    "raised": {"shoulder": ((0, 0, 68),)},
    "bent": {"shoulder": ((0, 0, -68),), "elbow": ((0, -80, 0),)},
    "on hips": {"shoulder": ((0, 0, -50), (70, 0, 0)), "elbow": ((0, -95, 0),)},
    "crossed": {"shoulder": ((0, -30, 0), (0, 0, -65), (50, 0, 0)), "elbow": ((0, -105, 0),)},
    "forwards": {"shoulder": ((0, -75, 0), (0, 0, -15))},
}
# Left and right arm where they differ.
_UNLIKE = (("hanging", "raised"), ("hanging", "bent"), ("hanging", "on hips"), ("hanging", "forwards"))
_LEGS: Mapping[str, tuple[_Turns, _Turns]] = {
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
_MIRROR = np.array([1.0, -1.0, -1.0])


def standing_poses(joint_count: int) -> Iterator[tuple[str, Float64[np.ndarray, "J 3"]]]:
    """Named axis-angle vectors of all joints, radians, of a body of the SMPL family; the pelvis is not turned."""
    arms = [(name, name) for name in _ARMS] + [*_UNLIKE, *((b, a) for a, b in _UNLIKE)]
    for left, right in arms:
        for name, (one, other) in _LEGS.items():
            title = f"arms {left}, legs {name}" if left == right else f"left arm {left}, right {right}, legs {name}"
            yield title, _turned(joint_count, _ARMS[left], _ARMS[right], one, other)
            if one != other:
                yield f"{title}, the other way", _turned(joint_count, _ARMS[left], _ARMS[right], other, one)


def _turned(joint_count: int, *parts: _Turns) -> Float64[np.ndarray, "J 3"]:
    place = {name: k for k, name in enumerate(JOINT_NAMES[joint_count])}
    out = np.tile(np.eye(3), (joint_count, 1, 1))
    for side, turns in zip(("left", "right", "left", "right"), parts, strict=True):
        for joint, vectors in turns.items():
            for vector in vectors:
                degrees = np.array(vector, dtype=np.float64) * (1.0 if side == "left" else _MIRROR)
                k = place[f"{side}_{joint}"]
                out[k] = out[k] @ matrix_from_rotvec(np.radians(degrees))
    return rotvec_from_matrix(out)
