"""Choose where a registration starts: from points in space, or from an initial fit with its estimated noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body import BodyModel
from smplxpp.core.rotations import matrix_from_rotvec, rotation_between, rotvec_from_matrix
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmarks import LandmarkModel
from smplxpp.register.observations import StartNoise


@dataclass(frozen=True, eq=False)
class Start:
    """An initial fit that enters the least squares as a measurement.

    Attributes:
        state: the fit.
        pose: standard deviation of each joint's rotation, radians; inf to ignore the rotations.
        transl: of the translation, metres; inf to ignore it.
        shape: of each coefficient of betas; inf to ignore them.
    """

    state: BodyState
    pose: float
    transl: float
    shape: float


def start_of(
    state: BodyState,
    frames: Int64[np.ndarray, " T"],
    rows: Int64[np.ndarray, " n"],
    *,
    stated: StartNoise | None,
    beside_keypoints: bool,
    beside_landmarks: bool,
) -> Start:
    """Return some rows of an initial fit, with standard deviations as stated or as its jitter shows.

    Beside keypoints the fit only informs rotations, because keypoints hardly show twists, and with twice its noise,
    because fits also have slow errors that jitter does not show. Beside landmarks alone it informs rotations and shape.

    Args:
        state: the initial fit in all frames.
        frames: numbers of all frames.
        rows: rows to return.
        stated: standard deviations that the user has given; None to estimate them.
        beside_keypoints: whether keypoints are fitted too.
        beside_landmarks: whether landmarks are fitted too.
    """
    if stated is not None:
        return Start(state.select(rows), stated.pose, stated.transl, stated.shape)
    # Typical errors of a tracker, where too few frames tell: 2 degrees, 1 cm, 0.3 betas. Lower bounds of what jitter
    # tells are 0.5 degrees and 3 mm.
    typical_pose, typical_transl, shape = np.radians(2.0), 0.01, 0.3
    pose, transl = white_noise(state, frames) or (typical_pose, typical_transl)
    pose, transl = max(pose, np.radians(0.5)), max(transl, 0.003)
    if beside_keypoints:
        return Start(state.select(rows), max(2.0 * pose, typical_pose), np.inf, np.inf)
    if beside_landmarks:
        return Start(state.select(rows), max(2.0 * pose, typical_pose), np.inf, shape)
    return Start(state.select(rows), pose, transl, shape)


def white_noise(state: BodyState, frames: Int64[np.ndarray, " T"]) -> tuple[float, float] | None:
    """Estimate the white noise of a fit, in radians a component and metres; None for fewer than eight frames.

    The second difference of white noise has six times its variance. The median of absolute values, times 1.4826, is a
    robust standard deviation: it ignores the real accelerations of few joints in few frames.
    """
    # Second differences need three frames at equal distances.
    triples = np.flatnonzero(np.diff(frames)[1:] == np.diff(frames)[:-1]) if len(frames) > 2 else np.zeros(0, int)
    if len(triples) < 6:
        return None
    # Relative rotations of consecutive frames stand for differences, so that their difference is a second difference.
    speed = rotvec_from_matrix(state.rotations[1:] @ state.rotations[:-1].transpose(0, 1, 3, 2))
    turn = (speed[1:] - speed[:-1])[triples]
    moved = np.diff(state.transl, n=2, axis=0)[triples]
    pose, transl = (float(1.4826 * np.median(np.abs(values)) / np.sqrt(6)) for values in (turn, moved))
    return pose, transl


def joined_points(
    body: BodyModel, tables: Sequence[tuple[Sequence[str], Float64[np.ndarray, "T _ 3"]]]
) -> tuple[LandmarkModel, Float64[np.ndarray, "T K 3"]]:
    """Merge tables of named points into one; where several have a point, the last table wins."""
    landmarks = LandmarkModel.of(body, tuple(dict.fromkeys(name for names, _ in tables for name in names)))
    points = np.full((len(tables[0][1]), len(landmarks.names), 3), np.nan)
    for names, found in tables:
        # Finite values overwrite; NaN leaves what an earlier table has.
        place = [landmarks.names.index(name) for name in names]
        points[:, place] = np.where(np.isfinite(found), found, points[:, place])
    return landmarks, points


def state_from_points(
    kinematics: Kinematics, landmarks: LandmarkModel, points: Float64[np.ndarray, "T K 3"]
) -> BodyState | None:
    """Align the T-pose with lowered arms rigidly to the points of the trunk in each frame; NaN points are missing.

    Frames with too few points are copied from the nearest frame that has enough. If no frame has enough points of the
    trunk, all points are used; the result is None if these are too few, or on a line.
    """
    # The T-pose with arms lowered by 40 degrees, from which hanging and raised arms are both reached.
    arms_down, least = np.radians(40.0), 3
    trunk = ("hip", "shoulder", "collar", "pelvis", "spine", "neck")  # points that move as one rigid body
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
        state.rotations[:, names.index(f"{side}_shoulder")] = matrix_from_rotvec(np.array([0.0, 0.0, sign * arms_down]))
    # Frames in which the trunk, or else all points, determine a rigid motion.
    known = np.isfinite(points).all(axis=2)
    of_trunk = known & [any(part in name for part in trunk) for name in landmarks.names]
    used, found = of_trunk, of_trunk.sum(axis=1) >= least
    if not found.any():
        used = known
        found = np.array([_determine_rotation(points[frame, known[frame]]) for frame in range(frames)])
    if not found.any():
        return None
    # Least-squares rigid alignment (Kabsch) of the rest pose; the root rotates about itself, not about the origin.
    rest = landmarks.points(body.v_template, kinematics.rest_joints)
    root = kinematics.rest_joints[np.flatnonzero(kinematics.parents < 0)[0]]
    for frame in np.flatnonzero(found):
        rotation, move = _rigid(rest[used[frame]], points[frame, used[frame]])
        state.rotations[frame, kinematics.parents < 0] = rotation
        state.transl[frame] = rotation @ root + move - root
    # Fill the other frames from the nearest one.
    have = np.flatnonzero(found)
    nearest = have[np.argmin(np.abs(np.arange(frames)[:, None] - have), axis=1)]
    return state.select(nearest)


def _determine_rotation(points: Float64[np.ndarray, "n 3"]) -> bool:
    """Return whether there are at least four points, and their second singular value exceeds 5 cm (no line)."""
    if len(points) < 4:
        return False
    # Points on a line leave the rotation about that line open.
    off_line = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
    return bool(off_line > 0.05)


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation and translation that map points to others with the least sum of squares (Kabsch)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    rotation = rotation_between(source - a, target - b).T
    return rotation, b - rotation @ a
