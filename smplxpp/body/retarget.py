"""Retarget a motion: copy joint rotations, scale root translation by leg length, keep planted feet planted.

Models of one family share their rest pose, so that joint rotations are copied (of SMPL's to the open body they are not:
`smplxpp.body.smpl_params`). Steps differ in length: the root's
translation is scaled by the ratio of the legs' lengths, and where a foot is planted on the source, the sliding that
other proportions would cause on the target is subtracted from the root.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from smplxpp.body.model import BodyModel
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.skinning.linear_blend import forward_kinematics

_LEG = ("hip", "knee", "ankle")
FEET = ("left_foot", "right_foot", "left_ankle", "right_ankle")
"""Joints that show contact with the floor."""


@dataclass(frozen=True, eq=False)
class Skeleton:
    """The joints of a body at rest.

    Attributes:
        names: of the joints, as SMPL's.
        parents: index of each joint's parent, -1 for the root.
        places: positions, metres.
    """

    names: tuple[str, ...]
    parents: Int64[np.ndarray, " J"]
    places: Float64[np.ndarray, "J 3"]

    @staticmethod
    def of(body: BodyModel, betas: Float64[np.ndarray, " B"] | None = None) -> Skeleton:
        """Return the skeleton of a body with the given shape, None for its mean shape.

        Raises:
            InputError: more betas than the body has.
        """
        shape = BodyParams.rest(betas=0 if betas is None else betas, expressions=0)
        return Skeleton(tuple(body.joint_names), np.asarray(body.parents), np.asarray(body.rest_joints(shape))[0])

    def at(self, *names: str) -> list[int]:
        """Return the indices of joints by name.

        Raises:
            InputError: a joint that the skeleton does not have.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise InputError("joints of a skeleton", expected=", ".join(names), received=f"no {', '.join(missing)}")
        return [self.names.index(name) for name in names]

    @property
    def has_legs(self) -> bool:
        """Whether the skeleton has the joints of both legs, and bones of some length between them."""
        needed = [f"{side}_{name}" for side in ("left", "right") for name in _LEG]
        return all(name in self.names for name in needed) and bool(np.ptp(self.places[self.at(*needed)], axis=0).any())

    @property
    def leg(self) -> float:
        """The length of a leg from hip to ankle, mean of both, metres.

        Raises:
            InputError: joints that are missing, or legs of no length.
        """
        lengths = []
        for side in ("left", "right"):
            hip, knee, ankle = self.places[self.at(*(f"{side}_{name}" for name in _LEG))]
            lengths.append(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        if not np.mean(lengths) > 0.0:
            raise InputError("legs of a skeleton", expected="bones of some length", received="none")
        return float(np.mean(lengths))

    def pose(self, params: BodyParams) -> Float64[np.ndarray, "T J 3"]:
        """Return the positions of the joints, metres, with fingers and face at rest."""
        count = len(self.names)
        rotations = np.tile(np.eye(3), (len(params), count, 1, 1))
        turned = np.concatenate([params.global_orient, params.body_pose], axis=1).reshape(len(params), -1, 3)
        rotations[:, : turned.shape[1]] = matrix_from_rotvec(turned)
        rest = np.repeat(self.places[None], len(params), axis=0)
        return forward_kinematics(rest, self.parents, rotations, transl=params.transl)[1]


def retarget(params: BodyParams, source: Skeleton, target: Skeleton) -> BodyParams:
    """Return a motion of `source` for `target`; retargeting to the same skeleton returns the motion unchanged.

    Args:
        params: T frames of the source; their shape is dropped.
        source: skeleton of the motion.
        target: skeleton that shall move.
    """
    # Scale the pelvis' path about its first position on the floor.
    scale = target.leg / source.leg
    own = source.pose(params)
    pelvis = own[:, 0]
    floor = own[:, source.at(*FEET), 1].min()
    start = pelvis[0] * [1.0, 0.0, 1.0] + [0.0, floor, 0.0]
    places = start + scale * (pelvis - start)
    moved = places - target.places[0]
    out = replace(params.without_shape(), transl=moved)
    return planted(out, scale * own[:, source.at(*FEET)], target, floor)


def planted(params: BodyParams, theirs: Float64[np.ndarray, "T K 3"], target: Skeleton, floor: float) -> BodyParams:
    """Return a motion whose planted feet move as the source's do, and whose lowest foot stands on the floor.

    Args:
        params: T frames of the target.
        theirs: `FEET` of the source, scaled to the target's size, metres.
        target: skeleton that moves.
        floor: height of the source's lowest foot, metres.
    """
    # Keep planted feet planted, then put the lowest foot on the floor.
    feet = target.pose(params)[:, target.at(*FEET)]
    moved = params.transl + held_feet(theirs, feet, target.leg, params.fps or DEFAULT_FPS)
    lowest = target.pose(replace(params, transl=moved))[:, target.at(*FEET), 1].min()
    moved[:, 1] += floor - lowest
    return replace(params, transl=moved)


def standing(feet: Float64[np.ndarray, "T K 3"], leg: float, fps: float) -> Float64[np.ndarray, "T-1 K"]:
    """Return how firmly each foot is planted between a frame and the next, in [0, 1], by its speed and its height.

    The weight `exp(-s^4) exp(-h^4)` is near 1 below 0.35 leg lengths a second and 0.06 leg lengths above the lowest
    height, and falls steeply above.
    """
    slow, low_height = 0.35, 0.06
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=2) * fps / (slow * leg)
    height = feet[..., 1] - feet[..., 1].min(axis=0)
    low = np.maximum(height[:-1], height[1:]) / (low_height * leg)
    return np.exp(-(speed**4)) * np.exp(-(low**4))


def held_feet(
    source: Float64[np.ndarray, "T K 3"], target: Float64[np.ndarray, "T K 3"], leg: float, fps: float
) -> Float64[np.ndarray, "T 3"]:
    """Return the correction of the target's root that makes planted feet move as the source's do.

    Args:
        source: feet of the source, scaled to the target's size, metres.
        target: feet of the target, metres.
        leg: length of the target's leg, metres.
        fps: frames a second.
    """
    # The mean sliding of planted feet in each step; the constant damps steps in which no foot is planted.
    share = standing(source, leg, fps)[..., None]
    too_far = np.diff(source, axis=0) - np.diff(target, axis=0)
    step = (share * too_far).sum(axis=1) / (share.sum(axis=1) + 0.05)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)]) * [1.0, 0.0, 1.0]


MARGIN = np.radians(10.0)
"""Largest angle in radians outside of the training that still counts as inside its range."""


@dataclass(frozen=True, eq=False)
class PoseRange:
    """The range of the body joints' rotations in training.

    Attributes:
        middle: mean rotation of each joint.
        reach: largest angle from the mean, with `MARGIN`, radians.
    """

    middle: Float64[np.ndarray, "21 3 3"]
    reach: Float64[np.ndarray, " 21"]

    @staticmethod
    def of(known: Float[np.ndarray, "K 63"]) -> PoseRange:
        """Return the range of the training poses, of which there is at least one."""
        rotations = matrix_from_rotvec(np.asarray(known, np.float64).reshape(-1, 21, 3))
        # The chordal mean: the rotation nearest to the mean of the matrices.
        u, _, vt = np.linalg.svd(rotations.mean(axis=0))
        u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
        middle = u @ vt
        reach = np.linalg.norm(rotvec_from_matrix(np.swapaxes(middle, 1, 2) @ rotations), axis=2).max(axis=0)
        return PoseRange(middle, reach + MARGIN)

    def outside(self, params: BodyParams) -> Bool[np.ndarray, "T 21"]:
        """Return which joints exceed the range of the training in each frame."""
        return np.linalg.norm(self._from_middle(params), axis=2) > self.reach

    def clamped(self, params: BodyParams) -> BodyParams:
        """Return the motion with joints outside the range rotated back to its border; others are unchanged."""
        away = self._from_middle(params)
        angle = np.linalg.norm(away, axis=2)
        too_far: Int64[np.ndarray, "n 2"] = np.argwhere(angle > self.reach)
        theta = np.array(params.body_pose).reshape(-1, 21, 3)
        for frame, joint in too_far:
            # Slightly less than the border, so that rounding does not leave it outside.
            held = away[frame, joint] * ((1.0 - 1e-9) * self.reach[joint] / angle[frame, joint])
            theta[frame, joint] = rotvec_from_matrix(self.middle[joint] @ matrix_from_rotvec(held))
        return replace(params, body_pose=theta.reshape(len(params), -1))

    def _from_middle(self, params: BodyParams) -> Float64[np.ndarray, "T 21 3"]:
        """Return the rotation vector from the mean to each joint's rotation."""
        rotations = matrix_from_rotvec(np.asarray(params.body_pose).reshape(-1, 21, 3))
        return rotvec_from_matrix(np.swapaxes(self.middle, 1, 2) @ rotations)
