"""A body that stands: feet planted by closed-form leg IK, observed joint ranges, clearance of hands from the trunk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.retarget import FEET, PoseRange, Skeleton
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.errors import one_line

BODY_JOINTS = 22
"""Number of joints that `global_orient` and `body_pose` rotate."""
_SIDES = ("left", "right")
_LEG_ROWS = [SMPLX_JOINTS.index(f"{side}_{name}") - 1 for side in _SIDES for name in ("hip", "knee", "ankle", "foot")]
_KNEE_SLACK = 0.001
"""Metres between a leg's greatest length and full extension, where the knee's angle is ill-conditioned."""


@dataclass(frozen=True, eq=False)
class StandingBody:
    """A body in a standing pose.

    Attributes:
        skeleton: joints at rest, with SMPL-X's names.
        standing: the one frame of the standing pose, facing +Z.
        observed_poses: body poses (K, 63) of the training; None if there are none.
        trunk_slices: rows of height, half width, front and back of the trunk at rest, metres, from the floor up.
    """

    skeleton: Skeleton
    standing: BodyParams
    observed_poses: Float64[np.ndarray, "K 63"] | None
    trunk_slices: Float64[np.ndarray, "S 4"]

    __repr__ = one_line

    @staticmethod
    def of(
        skeleton: Skeleton,
        frames: BodyParams,
        *,
        observed_poses: Float64[np.ndarray, "K 63"] | None = None,
        surface: Float64[np.ndarray, "V 3"] | None = None,
    ) -> StandingBody:
        """Choose the standing pose among observed frames.

        Args:
            skeleton: joints at rest.
            frames: observed frames, at least one.
            observed_poses: poses that limit the joints; None takes those of `frames` if there are several.
            surface: vertices of the clothed body at rest, metres; None models the trunk by the shoulders' width.

        Raises:
            InputError: a skeleton without SMPL's joints of the body, or no frame.
        """
        skeleton.at(*SMPLX_JOINTS[:BODY_JOINTS])
        if not len(frames):
            raise InputError("observed frames of the body", expected="at least one", received="none")
        poses = None
        if observed_poses is not None and len(observed_poses) >= 2:
            poses = np.asarray(observed_poses, np.float64).reshape(-1, 63)
        if poses is None and len(frames) > 1:
            poses = np.asarray(frames.body_pose)
        standing = _face_forward(_choose_standing_frame(skeleton, frames), skeleton)
        return StandingBody(skeleton, standing, poses, _slice_trunk(skeleton, surface))

    @cached_property
    def _range(self) -> PoseRange | None:
        return None if self.observed_poses is None else PoseRange.of(self.observed_poses)

    @cached_property
    def _joint_index(self) -> Mapping[str, int]:
        return {name: k for k, name in enumerate(self.skeleton.names)}

    def clamp_to_observed(self, params: BodyParams) -> BodyParams:
        """Return frames whose joints stay within the observed range and its margin; legs are left as they are."""
        if self._range is None:
            return params
        # Legs are solved by `plant_feet`, and clamping them would lift the feet.
        held = np.array(self._range.clamped(params).body_pose).reshape(len(params), -1, 3)
        held[:, _LEG_ROWS] = np.asarray(params.body_pose).reshape(len(params), -1, 3)[:, _LEG_ROWS]
        return replace(params, body_pose=held.reshape(len(params), -1))

    def local_rotations(self, params: BodyParams) -> Float64[np.ndarray, "T 22 3 3"]:
        """Return the rotations of the root and the body's joints, each relative to its parent."""
        vectors = np.concatenate([params.global_orient, params.body_pose], axis=1)
        return matrix_from_rotvec(np.asarray(vectors).reshape(len(params), BODY_JOINTS, 3))

    def plant_feet(self, params: BodyParams) -> BodyParams:
        """Return a motion whose feet keep the positions and rotations of `standing`, whatever root and hips do.

        Hip, knee and ankle are solved in closed form: the knee bends about its axis until the hip reaches the ankle,
        the leg then takes the smallest rotation, and the foot rotates back. A root too high for both legs is lowered,
        smoothly, by a soft maximum of both legs' excess.
        """
        rotations, standing = self.local_rotations(params), self.local_rotations(self.standing)[0]
        root = rotations[:, 0]
        pelvis = self.skeleton.places[0] + params.transl
        legs = [_LegSolver(self, side, standing) for side in _SIDES]
        # Lower the pelvis by softplus(softmax of the legs' excess heights), with a width of `_KNEE_SLACK`.
        excess = np.stack([leg.excess_height(root, pelvis) for leg in legs])
        down = _KNEE_SLACK * np.logaddexp(0.0, np.logaddexp(*(excess / _KNEE_SLACK)))
        pelvis = pelvis - down[:, None] * [0.0, 1.0, 0.0]
        for leg in legs:
            for joint, rotation in leg.solve(root, pelvis).items():
                rotations[:, joint] = rotation
        return replace(
            params,
            transl=pelvis - self.skeleton.places[0],
            body_pose=rotvec_from_matrix(rotations[:, 1:]).reshape(len(params), -1),
        )

    def hand_clearance(self, params: BodyParams) -> Float64[np.ndarray, " T"]:
        """Return the distance of hands from the trunk and from each other, metres; negative where they intersect.

        The trunk is a stack of upright ellipses about the root; distances are along the ray from its axis.
        """
        joints = self.skeleton.pose(params)
        hand_points = ("wrist", "index3", "middle3", "pinky3")
        hands = [
            [self._joint_index[f"{side}_{one}"] for one in hand_points if f"{side}_{one}" in self._joint_index]
            for side in _SIDES
        ]
        # Hands in the root's frame at rest, where the trunk's slices are.
        root = matrix_from_rotvec(np.asarray(params.global_orient))
        local = (joints - joints[:, :1]) @ root + self.skeleton.places[0]
        height, width, front, back = self.trunk_slices.T
        points = local[:, hands[0] + hands[1]]
        at = points[..., 1]
        # Scale of the ellipse at the point's height that passes through it, and the distance along the ray.
        half = 0.5 * (np.interp(at, height, front) - np.interp(at, height, back))
        middle = 0.5 * (np.interp(at, height, front) + np.interp(at, height, back))
        x, z = points[..., 0] / np.interp(at, height, width), (points[..., 2] - middle) / half
        scale = np.sqrt(x**2 + z**2)
        radius = np.hypot(points[..., 0], points[..., 2] - middle) / np.maximum(scale, 1e-9)
        from_trunk = np.where(at > height[-1], np.inf, (scale - 1.0) * radius).min(axis=1)
        between = np.linalg.norm(joints[:, hands[0], None] - joints[:, None, hands[1]], axis=-1).min(axis=(1, 2))
        return np.minimum(from_trunk, between - 0.04)  # half a hand's thickness each


class _LegSolver:
    """Two-bone inverse kinematics of a leg with a planted foot: thigh, shin and the hinge between them."""

    def __init__(self, body: StandingBody, side: str, standing: Float64[np.ndarray, "22 3 3"]) -> None:
        names, places = body.skeleton.names, body.skeleton.places
        self.joints = [names.index(f"{side}_{name}") for name in ("hip", "knee", "ankle")]
        hip, knee, ankle = self.joints
        self.offset = places[hip] - places[0]
        self.thigh, self.shin = places[knee] - places[hip], places[ankle] - places[knee]
        self.knee = standing[knee]
        self.hip_in_world = standing[0] @ standing[hip]
        self.foot_in_world = self.hip_in_world @ standing[knee] @ standing[ankle]
        start = places[0] + body.standing.transl[0] + standing[0] @ self.offset
        self.ankle = start + self.hip_in_world @ (self.thigh + self.knee @ self.shin)
        # Squared length of the leg at flexion a: |thigh + knee Rx(a) shin|^2 = constant + cosine cos(a) + sine sin(a).
        x, y, z = self.shin
        one, other = self.knee @ [0.0, y, z], self.knee @ [0.0, -z, y]
        self.constant = float(self.thigh @ self.thigh + self.shin @ self.shin + 2.0 * self.thigh @ self.knee[:, 0] * x)
        self.cosine, self.sine = 2.0 * float(self.thigh @ one), 2.0 * float(self.thigh @ other)
        self.full_length = np.sqrt(self.constant + np.hypot(self.cosine, self.sine))

    def excess_height(
        self, root: Float64[np.ndarray, "T 3 3"], pelvis: Float64[np.ndarray, "T 3"]
    ) -> Float64[np.ndarray, " T"]:
        """Return the height of the pelvis above where the extended leg reaches the ankle, metres."""
        # The hip lies on a sphere about the ankle with the extended leg as its radius; its top at the hip's x and z
        # is the
        # greatest height.
        to_hip = pelvis + root @ self.offset - self.ankle
        reach = (self.full_length - _KNEE_SLACK) ** 2 - to_hip[:, 0] ** 2 - to_hip[:, 2] ** 2
        return to_hip[:, 1] - np.sqrt(np.maximum(reach, 0.0))

    def solve(
        self, root: Float64[np.ndarray, "T 3 3"], pelvis: Float64[np.ndarray, "T 3"]
    ) -> dict[int, Float64[np.ndarray, "T 3 3"]]:
        """Return the local rotations of hip, knee and ankle by joint index."""
        to_ankle = self.ankle - pelvis - root @ self.offset
        # Flexion at which the leg's length equals the distance of hip and ankle.
        ratio = ((to_ankle**2).sum(axis=1) - self.constant) / np.hypot(self.cosine, self.sine)
        bend = np.arctan2(self.sine, self.cosine) + np.arccos(np.clip(ratio, -1.0, 1.0))
        knee = self.knee @ matrix_from_rotvec(bend[:, None] * [1.0, 0.0, 0.0])
        # Rotate the bent leg, which has the right length, onto the line from hip to ankle; then undo all rotations
        # above the
        # foot.
        leg = self.thigh + knee @ self.shin
        upper = _smallest_rotation(leg @ self.hip_in_world.T, to_ankle) @ self.hip_in_world
        hip = np.swapaxes(root, 1, 2) @ upper
        foot = np.swapaxes(upper @ knee, 1, 2) @ self.foot_in_world
        return dict(zip(self.joints, (hip, knee, foot), strict=True))


def _smallest_rotation(
    source: Float64[np.ndarray, "T 3"], target: Float64[np.ndarray, "T 3"]
) -> Float64[np.ndarray, "T 3 3"]:
    """Return the smallest rotations that align directions with target directions."""
    # Rotation about a x b by the angle atan2(|a x b|, a . b), accurate at small angles where arccos is not.
    a, b = (one / np.linalg.norm(one, axis=1, keepdims=True) for one in (source, target))
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (a * b).sum(axis=1, keepdims=True))
    return matrix_from_rotvec(axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0))


def _choose_standing_frame(skeleton: Skeleton, frames: BodyParams) -> BodyParams:
    """Return the frame nearest to the mean pose, among those with level feet and the straightest legs."""
    max_foot_difference = 0.02  # metres between the feet's heights
    max_extra_flexion = np.radians(5.0)  # of a knee, above the straightest legs observed
    joints = skeleton.pose(frames)
    feet = joints[:, skeleton.at(*FEET[:2]), 1]
    # Criteria of standing, metres: difference of the feet's heights, and height of the pelvis above the lower foot.
    apart = feet.max(axis=1) - feet.min(axis=1)
    tall = joints[:, 0, 1] - feet.min(axis=1)
    # Level feet and a high pelvis, or the most level feet if no frame has both.
    good = (apart < max(max_foot_difference, apart.min() + 1e-6)) & (tall > 0.9 * tall.max())
    good = good if good.any() else apart <= apart.min() + 1e-6
    knees = frames.body_pose.reshape(len(frames), -1, 3)[:, [_LEG_ROWS[1], _LEG_ROWS[5]]]
    bent = np.linalg.norm(knees, axis=2).max(axis=1)
    candidates = np.flatnonzero(good & (bent <= bent[good].min() + max_extra_flexion))
    # Of the candidates the one nearest to the mean pose, since an extreme of the recording makes an odd rest.
    away = np.linalg.norm(frames.body_pose[candidates] - frames.body_pose.mean(axis=0), axis=1)
    return frames.frame(int(candidates[np.argmin(away)]))


def _face_forward(frame: BodyParams, skeleton: Skeleton) -> BodyParams:
    """Rotate a frame about the vertical, in place, so that its hips lie along x and it faces +Z."""
    # The hips' axis in the horizontal plane gives the heading; atan2(z, x) about +y makes it lie along +x.
    left, right = skeleton.pose(frame)[0, skeleton.at("left_hip", "right_hip")]
    across = left - right
    turn = matrix_from_rotvec(np.array([0.0, np.arctan2(across[2], across[0]), 0.0]))
    return replace(frame, global_orient=rotvec_from_matrix(turn @ matrix_from_rotvec(frame.global_orient)))


def _slice_trunk(skeleton: Skeleton, surface: Float64[np.ndarray, "V 3"] | None) -> Float64[np.ndarray, "S 4"]:
    """Return the extents of the clothed trunk from the knees up to the armpits, a row every 4 cm."""
    step = 0.04
    inlier_share = 0.97  # quantile of a slice's points that bounds it, so that single points do not
    left, right, knee, neck = skeleton.places[skeleton.at("left_shoulder", "right_shoulder", "left_knee", "neck")]
    half = 0.5 * float(left[0] - right[0])
    heights = np.arange(knee[1], left[1] - 0.1, step)
    rows = []
    # Arms are left out by their distance from the middle.
    points = np.zeros((0, 3)) if surface is None else surface[np.abs(surface[:, 0]) < 2.5 * half]
    for y in heights:
        near = points[np.abs(points[:, 1] - y) < step]
        if len(near):
            low, high = np.quantile(near, [1.0 - inlier_share, inlier_share], axis=0)
            rows.append((y, max(high[0], -low[0]), high[2], low[2]))
    if not rows:
        # Without a surface the trunk is an elliptic cylinder, three quarters as deep as the shoulders are wide.
        deep = 0.75 * half
        rows = [(y, half, neck[2] + deep, neck[2] - deep) for y in (knee[1], left[1])]
    # The last slice continues up to the shoulders, where the arms leave the trunk.
    rows.append((left[1] + 0.05, *rows[-1][1:]))
    out = np.array(rows)
    out[:, 1] = np.maximum(out[:, 1], 0.01)
    out[:, 2] = np.maximum(out[:, 2], out[:, 3] + 0.02)
    return out
