"""Where a registration without a fit begins: a body turned and moved onto points in space."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core.rotations import matrix_from_rotvec, rotation_between
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmarks import LandmarkModel

# Points of the trunk, which turn as one; in order of preference for each place.
_TRUNK = ("hip", "shoulder", "collar", "pelvis", "spine", "neck")
_LEAST = 3
# Of all points together at least so many, metres off their common line: else nothing says which way they are turned.
_LEAST_ALL, _OFF_LINE = 4, 0.05
_ARMS_DOWN = np.radians(40.0)


def joined_points(
    body: BodyModel, tables: Sequence[tuple[Sequence[str], Float64[np.ndarray, "T _ 3"]]]
) -> tuple[LandmarkModel, Float64[np.ndarray, "T K 3"]]:
    """Tables of named points as one; where several have a point, the last one's counts."""
    landmarks = LandmarkModel.of(body, tuple(dict.fromkeys(name for names, _ in tables for name in names)))
    points = np.full((len(tables[0][1]), len(landmarks.names), 3), np.nan)
    for names, found in tables:
        place = [landmarks.names.index(name) for name in names]
        points[:, place] = np.where(np.isfinite(found), found, points[:, place])
    return landmarks, points


def state_from_points(
    kinematics: Kinematics, landmarks: LandmarkModel, points: Float64[np.ndarray, "T K 3"]
) -> BodyState | None:
    """The T-pose with lowered arms, its trunk moved rigidly onto points of each frame; NaN points are not there.

    Frames with too few points take the nearest frame that has them. Where no frame has them, all points stand for the
    trunk; None where these are too few, or on a line.
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
    known = np.isfinite(points).all(axis=2)
    of_trunk = known & [any(part in name for part in _TRUNK) for name in landmarks.names]
    used, found = of_trunk, of_trunk.sum(axis=1) >= _LEAST
    if not found.any():
        used = known
        found = np.array([_span(points[frame, known[frame]]) for frame in range(frames)])
    if not found.any():
        return None
    rest = landmarks.points(body.v_template, kinematics.rest_joints)
    root = kinematics.rest_joints[np.flatnonzero(kinematics.parents < 0)[0]]
    for frame in np.flatnonzero(found):
        rotation, move = _rigid(rest[used[frame]], points[frame, used[frame]])
        state.rotations[frame, kinematics.parents < 0] = rotation
        state.transl[frame] = rotation @ root + move - root
    have = np.flatnonzero(found)
    nearest = have[np.argmin(np.abs(np.arange(frames)[:, None] - have), axis=1)]
    return state.select(nearest)


def _span(points: Float64[np.ndarray, "n 3"]) -> bool:
    """Whether points are enough to turn a body onto."""
    if len(points) < _LEAST_ALL:
        return False
    off_line = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    return bool(off_line > _OFF_LINE)


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation and move that take points onto others in the least-squares sense."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    rotation = rotation_between(source - a, target - b).T
    return rotation, b - rotation @ a
