"""A lexicon of arm gestures, fitted to one person: arm poses close to observed ones, with hands clear of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from avatar.speech.standing_body import StandingBody
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.named_poses import ARM_JOINTS, ARM_POSES, MIRROR, ArmPose
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix

MAX_DEVIATION = np.radians(20.0)
"""Largest rotation, in radians, between a joint of a gesture and the nearest observed arm."""
STATE_SIZE = 22
"""Length of the state of both arms: rotation vectors of `ARM_JOINTS`, left then right, and two finger bends a hand."""
_SIDES = ("left", "right")
_ARM_ROWS = {side: [SMPLX_JOINTS.index(f"{side}_{name}") - 1 for name in ARM_JOINTS] for side in _SIDES}
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")


_SYMMETRIC = ("belly", "front", "offered", "wide", "low", "raised")
_ASYMMETRIC = (
    *(("raised", "low"), ("belly", "offered"), ("front", "belly"), ("counting", "belly"), ("hanging", "chest")),
    *(("wide", "hanging"), ("raised", "hanging"), ("front", "hanging"), ("offered", "hanging"), ("offered", "low")),
    *(("wide", "low"), ("front", "offered"), ("raised", "belly"), ("chest", "low"), ("counting", "hanging")),
    *(("counting", "low"), ("raised", "offered"), ("front", "low"), ("wide", "belly")),
)
POSE_PAIRS = (
    *((name, name) for name in _SYMMETRIC),
    *_ASYMMETRIC,
    *((right, left) for left, right in _ASYMMETRIC),
)
"""Gestures of a talking person: the pose of the left arm and that of the right arm."""
REST_PAIR = ("hanging", "hanging")


@dataclass(frozen=True, eq=False)
class GestureLexicon:
    """The gestures that one person's arms can make.

    Attributes:
        rest: state of hanging arms.
        pairs: names of the poses of the left and the right arm, a gesture each.
        states: state of each gesture.
        body: the person.
    """

    rest: Float64[np.ndarray, " 22"]
    pairs: tuple[tuple[str, str], ...]
    states: Float64[np.ndarray, "P 22"]
    body: StandingBody

    @staticmethod
    def of(body: StandingBody) -> GestureLexicon:
        """Fit `POSE_PAIRS` to the observed poses of a body, without pairs whose hands would collide with it."""
        fitted = {name: [_limit_to_observed(body, side, pose) for side in _SIDES] for name, pose in ARM_POSES.items()}

        def state(left: str, right: str) -> Float64[np.ndarray, " 22"]:
            fingers = np.radians([*ARM_POSES[left].fingers, *ARM_POSES[right].fingers])
            return np.concatenate([fitted[left][0].ravel(), fitted[right][1].ravel(), fingers])

        rest = state(*REST_PAIR)
        pairs, states = [], []
        for pair in POSE_PAIRS:
            found = _raise_until_clear(body, rest, state(*pair))
            if found is not None:
                pairs.append(pair)
                states.append(found)
        return GestureLexicon(rest, tuple(pairs), np.array(states).reshape(-1, STATE_SIZE), body)

    def is_path_clear(self, start: Float64[np.ndarray, " 22"], end: Float64[np.ndarray, " 22"]) -> bool:
        """Return whether hands stay clear of the body and each other on the straight path between two states."""
        return bool(_are_paths_clear(self.body, start[None], end[None], self.rest)[0])

    def clear_paths(self) -> Bool[np.ndarray, "Q Q"]:
        """Return between which gestures hands stay clear on the straight path; Q = P + 1, the last one is rest."""
        ends = np.concatenate([self.states, self.rest[None]])
        first, second = np.triu_indices(len(ends), 1)
        clear = np.eye(len(ends), dtype=bool)
        clear[first, second] = _are_paths_clear(self.body, ends[first], ends[second], self.rest)
        return clear | clear.T


def pose_arms(
    standing: BodyParams, states: Float64[np.ndarray, "T 22"], rest: Float64[np.ndarray, " 22"]
) -> BodyParams:
    """Return frames of a body with its arms in given states; fingers add their flexion relative to rest.

    Hands whose pose is not stored as axis-angle vectors of 15 joints keep their fingers.
    """
    frames = standing.select(np.zeros(len(states), dtype=np.int64))
    # The first 18 numbers of a state are the rotation vectors of three joints an arm, left then right.
    pose = np.array(frames.body_pose).reshape(len(states), -1, 3)
    pose[:, [*_ARM_ROWS["left"], *_ARM_ROWS["right"]]] = states[:, :18].reshape(-1, 6, 3)
    hands = {f"{side}_hand_pose": np.array(getattr(frames, f"{side}_hand_pose")) for side in _SIDES}
    for k, side in enumerate(_SIDES):
        hand = hands[f"{side}_hand_pose"]
        if hand.shape[1] == 3 * 3 * len(_FINGERS):
            # Fingers but the thumb flex about z, with opposite signs on the two sides.
            joints = hand.reshape(len(states), len(_FINGERS), 3, 3)
            flexion = states[:, 18 + 2 * k : 20 + 2 * k] - rest[18 + 2 * k : 20 + 2 * k]
            for finger in range(4):
                joints[:, finger, :, 2] += (1.0 if k else -1.0) * flexion[:, 0 if finger == 0 else 1, None]
            hands[f"{side}_hand_pose"] = joints.reshape(len(states), -1)
    return replace(
        frames,
        body_pose=pose.reshape(len(states), -1),
        left_hand_pose=hands["left_hand_pose"],
        right_hand_pose=hands["right_hand_pose"],
    )


def largest_rotation(one: Float64[np.ndarray, " 22"], other: Float64[np.ndarray, " 22"]) -> float:
    """Return the largest rotation of a joint of the arms between two states, radians."""
    # The first 18 numbers are the rotation vectors of the six joints; fingers are not counted.
    apart = _relative_rotvec(matrix_from_rotvec(one[:18].reshape(6, 3)), matrix_from_rotvec(other[:18].reshape(6, 3)))
    return float(np.linalg.norm(apart, axis=-1).max())


def shuffle_recent_last(count: int, recent: Sequence[int], rng: np.random.Generator) -> list[int]:
    """Return the numbers below `count` in random order, recently used ones last, the oldest of these first."""
    # Most recent first and each once; three quarters of the gestures at most wait, so that the choice stays random.
    late = list(dict.fromkeys(reversed(recent)))[: (3 * count) // 4]
    fresh = [k for k in rng.permutation(count).tolist() if k not in late]
    return fresh + late[::-1]


def _limit_to_observed(body: StandingBody, side: str, pose: ArmPose) -> Float64[np.ndarray, "3 3"]:
    """Return a pose's rotation vectors, limited to `MAX_DEVIATION` from the nearest observed arm."""
    wanted = pose.rotations * (MIRROR if side == "right" else 1.0)
    if body.observed_poses is None:
        return wanted
    # The nearest arm minimises the squared joint angles; the wrist counts less, since it moves the hand least.
    joint_weights = np.array([1.0, 1.0, 0.3])
    observed = matrix_from_rotvec(body.observed_poses.reshape(len(body.observed_poses), -1, 3)[:, _ARM_ROWS[side]])
    away = _relative_rotvec(observed, matrix_from_rotvec(wanted))
    size = np.linalg.norm(away, axis=2)
    best = int(np.argmin((size**2) @ joint_weights))
    # Each joint is rotated from the observed pose towards the wanted one, by MAX_DEVIATION at most.
    held = away[best] * np.minimum(1.0, MAX_DEVIATION / np.maximum(size[best], 1e-9))[:, None]
    return rotvec_from_matrix(observed[best] @ matrix_from_rotvec(held))


def _relative_rotvec(a: Float64[np.ndarray, "*N 3 3"], b: Float64[np.ndarray, "*M 3 3"]) -> Float64[np.ndarray, "*N 3"]:
    """Return the rotation vectors from a to b, in a's frame."""
    return rotvec_from_matrix(np.swapaxes(a, -1, -2) @ b)


def _raise_until_clear(
    body: StandingBody, rest: Float64[np.ndarray, " 22"], state: Float64[np.ndarray, " 22"]
) -> Float64[np.ndarray, " 22"] | None:
    """Abduct the upper arms in small steps until the path from rest is clear; None where five steps do not suffice."""
    step = np.radians(4.0)
    for _ in range(5):
        if _are_paths_clear(body, rest[None], state[None], rest)[0]:
            return state
        state = np.array(state)
        # State entries 0 and 9 begin the shoulders' rotation vectors; abduction is about z, mirrored on the right.
        for k, sign in ((0, 1.0), (9, -1.0)):
            lift = matrix_from_rotvec(np.array([0.0, 0.0, sign * step]))
            state[k : k + 3] = rotvec_from_matrix(lift @ matrix_from_rotvec(state[k : k + 3]))
    return None


def _are_paths_clear(
    body: StandingBody,
    starts: Float64[np.ndarray, "M 22"],
    ends: Float64[np.ndarray, "M 22"],
    rest: Float64[np.ndarray, " 22"],
) -> Bool[np.ndarray, " M"]:
    """Test seven states a path: hands keep 2 cm of clearance, or at most 5 mm less than hanging arms have."""
    # The last row is the person at rest, whose clearance is the reference: wide clothes may leave less than 2 cm.
    paths = starts[:, None] + np.linspace(0.0, 1.0, 7)[:, None] * (ends - starts)[:, None]
    states = np.concatenate([paths.reshape(-1, STATE_SIZE), rest[None]])
    distance = body.hand_clearance(pose_arms(body.standing, states, rest))
    lowest = np.min(distance[:-1].reshape(-1, 7), axis=1, keepdims=True)
    return (lowest >= min(0.02, float(distance[-1]) - 0.005))[:, 0]
