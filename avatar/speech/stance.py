"""How a body stands: a frame with its feet on the floor, hips that move over them, arms clear of the trunk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.pose_range import PoseRange
from smplxpp.body.retarget import FEET, Skeleton
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

BODY_JOINTS = 22
"""Joints that the root's and the body's pose turn."""
_SIDES = ("left", "right")
_LEGS = [SMPLX_JOINTS.index(f"{side}_{name}") - 1 for side in _SIDES for name in ("hip", "knee", "ankle", "foot")]
_SOFT = 0.001  # metres by which knees stay short of straight
_LEVEL = 0.02  # metres between both feet's heights over the floor, of one who stands
_STRAIGHT = np.radians(5.0)  # beyond the straightest legs that were seen
_POINTS = ("wrist", "index3", "middle3", "pinky3")  # where a hand is
_HALF_DEPTH = 0.75  # of the half width of hips, where there is no surface to tell
_SLICE = 0.04  # metres of height
_AROUND = 0.97  # share of a slice's points within its width and depth


@dataclass(frozen=True, eq=False)
class Stance:
    """A body that stands.

    Attributes:
        skeleton: its joints at rest, named as SMPL-X's.
        still: the one frame in which it stands, facing +Z.
        known: body poses (K, 63) that training saw; None: nobody knows.
        girth: rows of height, half width, front and back of the trunk at rest, metres, from the floor up.
    """

    skeleton: Skeleton
    still: BodyParams
    known: Float64[np.ndarray, "K 63"] | None
    girth: Float64[np.ndarray, "S 4"]

    @staticmethod
    def of(
        skeleton: Skeleton,
        seen: BodyParams,
        *,
        known: Float64[np.ndarray, "K 63"] | None = None,
        surface: Float64[np.ndarray, "V 3"] | None = None,
    ) -> Stance:
        """Choose how a body stands from frames in which it was seen.

        Args:
            seen: at least one frame. known: poses beside them. surface: the clothed body at rest, metres.

        Raises:
            InputError: a skeleton without SMPL's joints of the body, or no frame.
        """
        skeleton.at(*SMPLX_JOINTS[:BODY_JOINTS])
        if not len(seen):
            raise InputError("frames that a body is seen in", expected="at least one", received="none")
        poses = None if known is None or len(known) < 2 else np.asarray(known, np.float64).reshape(-1, 63)
        if poses is None and len(seen) > 1:
            poses = np.asarray(seen.body_pose)
        return Stance(skeleton, _facing(_standing(skeleton, seen), skeleton), poses, _girth(skeleton, surface))

    @cached_property
    def _range(self) -> PoseRange | None:
        return None if self.known is None else PoseRange.of(self.known)

    @cached_property
    def _bones(self) -> Mapping[str, int]:
        return {name: k for k, name in enumerate(self.skeleton.names)}

    def within(self, params: BodyParams) -> BodyParams:
        """Return frames whose joints, but for the legs', turn no farther than training saw and a margin."""
        if self._range is None:
            return params
        held = np.array(self._range.clamped(params).body_pose).reshape(len(params), -1, 3)
        held[:, _LEGS] = np.asarray(params.body_pose).reshape(len(params), -1, 3)[:, _LEGS]
        return replace(params, body_pose=held.reshape(len(params), -1))

    def turns(self, params: BodyParams) -> Float64[np.ndarray, "T 22 3 3"]:
        """Return the rotations of the root and the body's joints, each relative to its parent."""
        vectors = np.concatenate([params.global_orient, params.body_pose], axis=1)
        return matrix_from_rotvec(np.asarray(vectors).reshape(len(params), BODY_JOINTS, 3))

    def planted(self, params: BodyParams) -> BodyParams:
        """Return a motion whose feet are where and as they are in `still`, whatever root and hips do.

        Hip, knee and ankle are solved in closed form: the knee bends about its axis until the hip reaches the ankle,
        the leg then turns the shortest way, and the foot turns back. A root that is too high for both legs comes down.
        """
        turns, still = self.turns(params), self.turns(self.still)[0]
        root = turns[:, 0]
        pelvis = self.skeleton.places[0] + params.transl
        legs = [_Leg(self, side, still) for side in _SIDES]
        drops = np.stack([leg.too_high(root, pelvis) for leg in legs])
        down = _SOFT * np.logaddexp(0.0, np.logaddexp(*(drops / _SOFT)))
        pelvis = pelvis - down[:, None] * [0.0, 1.0, 0.0]
        for leg in legs:
            for joint, turn in leg.solved(root, pelvis).items():
                turns[:, joint] = turn
        return replace(
            params,
            transl=pelvis - self.skeleton.places[0],
            body_pose=rotvec_from_matrix(turns[:, 1:]).reshape(len(params), -1),
        )

    def clearance(self, params: BodyParams) -> Float64[np.ndarray, " T"]:
        """Return how far hands are from the trunk and from each other, metres; below 0 they are within.

        The trunk is an upright pile of ellipses about the root; distances to it are those along the ray from its axis.
        """
        joints = self.skeleton.pose(params)
        hands = [[self._bones[f"{side}_{one}"] for one in _POINTS if f"{side}_{one}" in self._bones] for side in _SIDES]
        root = matrix_from_rotvec(np.asarray(params.global_orient))
        local = (joints - joints[:, :1]) @ root + self.skeleton.places[0]
        height, width, front, back = self.girth.T
        points = local[:, hands[0] + hands[1]]
        at = points[..., 1]
        half = 0.5 * (np.interp(at, height, front) - np.interp(at, height, back))
        middle = 0.5 * (np.interp(at, height, front) + np.interp(at, height, back))
        x, z = points[..., 0] / np.interp(at, height, width), (points[..., 2] - middle) / half
        scale = np.sqrt(x**2 + z**2)
        radius = np.hypot(points[..., 0], points[..., 2] - middle) / np.maximum(scale, 1e-9)
        from_trunk = np.where(at > height[-1], np.inf, (scale - 1.0) * radius).min(axis=1)
        between = np.linalg.norm(joints[:, hands[0], None] - joints[:, None, hands[1]], axis=-1).min(axis=(1, 2))
        return np.minimum(from_trunk, between - 0.04)  # half a hand's thickness each


class _Leg:
    """A leg whose foot stays: two bones and the hinge between them."""

    def __init__(self, stance: Stance, side: str, still: Float64[np.ndarray, "22 3 3"]) -> None:
        names, places = stance.skeleton.names, stance.skeleton.places
        self.joints = [names.index(f"{side}_{name}") for name in ("hip", "knee", "ankle")]
        hip, knee, ankle = self.joints
        self.offset = places[hip] - places[0]
        self.thigh, self.shin = places[knee] - places[hip], places[ankle] - places[knee]
        self.knee = still[knee]
        self.hip_in_world = still[0] @ still[hip]
        self.foot_in_world = self.hip_in_world @ still[knee] @ still[ankle]
        start = places[0] + stance.still.transl[0] + still[0] @ self.offset
        self.ankle = start + self.hip_in_world @ (self.thigh + self.knee @ self.shin)
        # |thigh + knee Rx(a) shin|^2 = all + along cos(a) + across sin(a)
        x, y, z = self.shin
        one, other = self.knee @ [0.0, y, z], self.knee @ [0.0, -z, y]
        self.all = float(self.thigh @ self.thigh + self.shin @ self.shin + 2.0 * self.thigh @ self.knee[:, 0] * x)
        self.along, self.across = 2.0 * float(self.thigh @ one), 2.0 * float(self.thigh @ other)
        self.straight = np.sqrt(self.all + np.hypot(self.along, self.across))

    def too_high(
        self, root: Float64[np.ndarray, "T 3 3"], pelvis: Float64[np.ndarray, "T 3"]
    ) -> Float64[np.ndarray, " T"]:
        """How far the pelvis is above where the straight leg would reach the ankle, metres."""
        way = pelvis + root @ self.offset - self.ankle
        reach = (self.straight - _SOFT) ** 2 - way[:, 0] ** 2 - way[:, 2] ** 2
        return way[:, 1] - np.sqrt(np.maximum(reach, 0.0))

    def solved(
        self, root: Float64[np.ndarray, "T 3 3"], pelvis: Float64[np.ndarray, "T 3"]
    ) -> dict[int, Float64[np.ndarray, "T 3 3"]]:
        """The rotations of hip, knee and ankle."""
        way = self.ankle - pelvis - root @ self.offset
        ratio = ((way**2).sum(axis=1) - self.all) / np.hypot(self.along, self.across)
        bend = np.arctan2(self.across, self.along) + np.arccos(np.clip(ratio, -1.0, 1.0))
        knee = self.knee @ matrix_from_rotvec(bend[:, None] * [1.0, 0.0, 0.0])
        leg = self.thigh + knee @ self.shin
        upper = _shortest(leg @ self.hip_in_world.T, way) @ self.hip_in_world
        hip = np.swapaxes(root, 1, 2) @ upper
        foot = np.swapaxes(upper @ knee, 1, 2) @ self.foot_in_world
        return dict(zip(self.joints, (hip, knee, foot), strict=True))


def _shortest(source: Float64[np.ndarray, "T 3"], target: Float64[np.ndarray, "T 3"]) -> Float64[np.ndarray, "T 3 3"]:
    """The smallest rotations that take directions to others."""
    a, b = (one / np.linalg.norm(one, axis=1, keepdims=True) for one in (source, target))
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (a * b).sum(axis=1, keepdims=True))
    return matrix_from_rotvec(axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0))


def _standing(skeleton: Skeleton, seen: BodyParams) -> BodyParams:
    """The frame nearest to the mean of those with both feet at the same height on the straightest legs."""
    joints = skeleton.pose(seen)
    feet = joints[:, skeleton.at(*FEET[:2]), 1]
    apart = feet.max(axis=1) - feet.min(axis=1)
    tall = joints[:, 0, 1] - feet.min(axis=1)
    good = (apart < max(_LEVEL, apart.min() + 1e-6)) & (tall > 0.9 * tall.max())
    good = good if good.any() else apart <= apart.min() + 1e-6
    knees = seen.body_pose.reshape(len(seen), -1, 3)[:, [_LEGS[1], _LEGS[5]]]
    bent = np.linalg.norm(knees, axis=2).max(axis=1)
    frames = np.flatnonzero(good & (bent <= bent[good].min() + _STRAIGHT))
    away = np.linalg.norm(seen.body_pose[frames] - seen.body_pose.mean(axis=0), axis=1)
    return seen.frame(int(frames[np.argmin(away)]))


def _facing(still: BodyParams, skeleton: Skeleton) -> BodyParams:
    """The same turned about the vertical so that its hips lie along x, and its face looks to +Z; where it stands."""
    left, right = skeleton.pose(still)[0, skeleton.at("left_hip", "right_hip")]
    across = left - right
    turn = matrix_from_rotvec(np.array([0.0, np.arctan2(across[2], across[0]), 0.0]))
    return replace(still, global_orient=rotvec_from_matrix(turn @ matrix_from_rotvec(still.global_orient)))


def _girth(skeleton: Skeleton, surface: Float64[np.ndarray, "V 3"] | None) -> Float64[np.ndarray, "S 4"]:
    """Slices of the trunk and what is worn about it, up to the armpits."""
    left, right, knee, neck = skeleton.places[skeleton.at("left_shoulder", "right_shoulder", "left_knee", "neck")]
    half = 0.5 * float(left[0] - right[0])
    heights = np.arange(knee[1], left[1] - 0.1, _SLICE)
    rows = []
    points = np.zeros((0, 3)) if surface is None else surface[np.abs(surface[:, 0]) < 2.5 * half]
    for y in heights:
        near = points[np.abs(points[:, 1] - y) < _SLICE]
        if len(near):
            low, high = np.quantile(near, [1.0 - _AROUND, _AROUND], axis=0)
            rows.append((y, max(high[0], -low[0]), high[2], low[2]))
    if not rows:
        deep = _HALF_DEPTH * half
        rows = [(y, half, neck[2] + deep, neck[2] - deep) for y in (knee[1], left[1])]
    rows.append((left[1] + 0.05, *rows[-1][1:]))  # the arms go out from here: the chest goes on
    out = np.array(rows)
    out[:, 1] = np.maximum(out[:, 1], 0.01)
    out[:, 2] = np.maximum(out[:, 2], out[:, 3] + 0.02)
    return out
