"""Arms that go from gesture to gesture: shapes near poses that training saw, clear of the body, not the same soon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from avatar.speech.gestures import ARM_JOINTS, ARMS, MIRROR, PAIRS, REST, Arm
from avatar.speech.stance import Stance
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

REACH = np.radians(20.0)
"""Angle by which a joint of a shape is away from the nearest arm that training saw, at most."""
WIDTH = 22
"""Numbers of a state of both arms: rotation vectors of `ARM_JOINTS`, left and right, and bends of the fingers."""
_SIDES = ("left", "right")
_ROWS = {side: [SMPLX_JOINTS.index(f"{side}_{name}") - 1 for name in ARM_JOINTS] for side in _SIDES}
_WEIGHTS = np.array([1.0, 1.0, 0.3])  # of the joints of an arm, where the nearest is sought
_CLEAR = 0.02  # metres that hands keep from the trunk and each other, unless they hang closer
_WAY = np.linspace(0.0, 1.0, 7)
_AWAY, _STEPS = np.radians(4.0), 5  # by which an arm that is not clear is lifted aside, and how often
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """What both arms of one person can do.

    Attributes:
        rest: the state of hanging arms. pairs: names of the shapes of the left and the right arm. states: of each pair.
        stance: of the person.
    """

    rest: Float64[np.ndarray, " 22"]
    pairs: tuple[tuple[str, str], ...]
    states: Float64[np.ndarray, "P 22"]
    stance: Stance

    @staticmethod
    def of(stance: Stance) -> Vocabulary:
        """Fit the shapes to the poses that training saw, and leave out pairs whose hands do not clear the body."""
        near = {name: [_nearest(stance, side, arm) for side in _SIDES] for name, arm in ARMS.items()}

        def state(left: str, right: str) -> Float64[np.ndarray, " 22"]:
            fingers = np.radians([*ARMS[left].fingers, *ARMS[right].fingers])
            return np.concatenate([near[left][0].ravel(), near[right][1].ravel(), fingers])

        rest = state(*REST)
        pairs, states = [], []
        for pair in PAIRS:
            found = _cleared(stance, rest, state(*pair))
            if found is not None:
                pairs.append(pair)
                states.append(found)
        return Vocabulary(rest, tuple(pairs), np.array(states).reshape(-1, WIDTH), stance)

    def clear(self, start: Float64[np.ndarray, " 22"], end: Float64[np.ndarray, " 22"]) -> bool:
        """Whether hands are clear of the body and each other all the way from one state to another."""
        return _clear(self.stance, start, end, self.rest)


def posed(still: BodyParams, states: Float64[np.ndarray, "T 22"], rest: Float64[np.ndarray, " 22"]) -> BodyParams:
    """Return frames of a body with the arms of states; fingers bend as much more than they rest, where they can."""
    frames = still.select(np.zeros(len(states), dtype=np.int64))
    pose = np.array(frames.body_pose).reshape(len(states), -1, 3)
    pose[:, [*_ROWS["left"], *_ROWS["right"]]] = states[:, :18].reshape(-1, 6, 3)
    hands = {f"{side}_hand_pose": np.array(getattr(frames, f"{side}_hand_pose")) for side in _SIDES}
    for k, side in enumerate(_SIDES):
        hand = hands[f"{side}_hand_pose"]
        if hand.shape[1] == 3 * 3 * len(_FINGERS):
            joints = hand.reshape(len(states), len(_FINGERS), 3, 3)
            more = states[:, 18 + 2 * k : 20 + 2 * k] - rest[18 + 2 * k : 20 + 2 * k]
            for finger in range(4):
                joints[:, finger, :, 2] += (1.0 if k else -1.0) * more[:, 0 if finger == 0 else 1, None]
            hands[f"{side}_hand_pose"] = joints.reshape(len(states), -1)
    return replace(
        frames,
        body_pose=pose.reshape(len(states), -1),
        left_hand_pose=hands["left_hand_pose"],
        right_hand_pose=hands["right_hand_pose"],
    )


def turned_between(one: Float64[np.ndarray, " 22"], other: Float64[np.ndarray, " 22"]) -> float:
    """Return the largest angle by which a joint of an arm turns from one state to another, radians."""
    apart = _angles(matrix_from_rotvec(one[:18].reshape(6, 3)), matrix_from_rotvec(other[:18].reshape(6, 3)))
    return float(np.linalg.norm(apart, axis=-1).max())


def shuffled(count: int, recent: Sequence[int], rng: np.random.Generator) -> list[int]:
    """Return the numbers below `count` in the order in which they are tried: at random, lately used ones last."""
    late = list(dict.fromkeys(reversed(recent)))[: (3 * count) // 4]
    fresh = [k for k in rng.permutation(count).tolist() if k not in late]
    return fresh + late[::-1]


def _nearest(stance: Stance, side: str, arm: Arm) -> Float64[np.ndarray, "3 3"]:
    """The rotation vectors of a shape, brought within `REACH` of the nearest arm that was seen."""
    wanted = arm.turns * (MIRROR if side == "right" else 1.0)
    if stance.known is None:
        return wanted
    seen = matrix_from_rotvec(stance.known.reshape(len(stance.known), -1, 3)[:, _ROWS[side]])
    away = _angles(seen, matrix_from_rotvec(wanted))
    size = np.linalg.norm(away, axis=2)
    best = int(np.argmin((size**2) @ _WEIGHTS))
    held = away[best] * np.minimum(1.0, REACH / np.maximum(size[best], 1e-9))[:, None]
    return rotvec_from_matrix(seen[best] @ matrix_from_rotvec(held))


def _angles(a: Float64[np.ndarray, "*N 3 3"], b: Float64[np.ndarray, "*M 3 3"]) -> Float64[np.ndarray, "*N 3"]:
    """The rotation vectors from a to b, in a's frame."""
    return rotvec_from_matrix(np.swapaxes(a, -1, -2) @ b)


def _cleared(
    stance: Stance, rest: Float64[np.ndarray, " 22"], state: Float64[np.ndarray, " 22"]
) -> Float64[np.ndarray, " 22"] | None:
    """A state whose upper arms are lifted aside until the way from rest to it is clear; None where that is too far."""
    for _ in range(_STEPS):
        if _clear(stance, rest, state, rest):
            return state
        state = np.array(state)
        for k, sign in ((0, 1.0), (9, -1.0)):
            lift = matrix_from_rotvec(np.array([0.0, 0.0, sign * _AWAY]))
            state[k : k + 3] = rotvec_from_matrix(lift @ matrix_from_rotvec(state[k : k + 3]))
    return None


def _clear(
    stance: Stance,
    start: Float64[np.ndarray, " 22"],
    end: Float64[np.ndarray, " 22"],
    rest: Float64[np.ndarray, " 22"],
) -> bool:
    way = start + _WAY[:, None] * (end - start)
    distance = stance.clearance(posed(stance.still, np.concatenate([way, rest[None]]), rest))
    return bool((distance[:-1] >= min(_CLEAR, float(distance[-1]) - 0.005)).all())
