"""Where a registration without a fit begins: a body turned and moved onto triangulated points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmarks import LandmarkModel

# Points of the trunk, which turn as one; in order of preference for each place.
_TRUNK = ("hip", "shoulder", "collar", "pelvis", "spine", "neck")
_LEAST = 3
_ARMS_DOWN = np.radians(40.0)


def state_from_points(
    kinematics: Kinematics, landmarks: LandmarkModel, points: Float64[np.ndarray, "T K 3"]
) -> BodyState | None:
    """The T-pose with lowered arms, its trunk moved rigidly onto points of each frame; NaN points are not there.

    Frames with too few points take the nearest frame that has them; None where no frame has any.
    """
    body = kinematics.body
    frames = len(points)
    state = BodyState(
        rotations=np.tile(np.eye(3), (frames, body.joint_count, 1, 1)),
        transl=np.zeros((frames, 3)),
        betas=np.zeros(body.num_betas),
        expression=np.zeros((frames, body.num_expressions)),
    )
    names = list(body.joint_names)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        state.rotations[:, names.index(f"{side}_shoulder")] = matrix_from_rotvec(
            np.array([0.0, 0.0, sign * _ARMS_DOWN])
        )
    rest = landmarks.points(body.v_template, kinematics.rest_joints)
    trunk = np.array([any(part in name for part in _TRUNK) for name in landmarks.names])
    root = kinematics.rest_joints[np.flatnonzero(kinematics.parents < 0)[0]]
    found = np.zeros(frames, dtype=bool)
    for frame in range(frames):
        there = trunk & np.isfinite(points[frame]).all(axis=1)
        if there.sum() < _LEAST:
            continue
        rotation, move = _rigid(rest[there], points[frame, there])
        state.rotations[frame, kinematics.parents < 0] = rotation
        state.transl[frame] = rotation @ root + move - root
        found[frame] = True
    if not found.any():
        return None
    have = np.flatnonzero(found)
    nearest = have[np.argmin(np.abs(np.arange(frames)[:, None] - have), axis=1)]
    return state.select(nearest)


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and move that take points onto others in the least-squares sense (Kabsch 1976)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ sign @ u.T
    return rotation, b - rotation @ a
