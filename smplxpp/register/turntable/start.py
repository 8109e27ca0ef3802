"""Find the heading of a person in every frame of one camera: candidate headings, then the best path (Viterbi).

Each frame is compared with the body at rest, arms lowered, rotated about the vertical in steps of 10 degrees and placed
where its points of trunk, head and legs project best. The cost of a heading is the mean truncated reprojection error,
plus a penalty for face points that are visible and not detected, or detected and not visible. The path minimises the
sum of these costs and of the deviations from a steady rotation, once to the left and once to the right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from smplxpp.core import Camera, Keypoints2D, matrix_from_rotvec
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmarks import LandmarkModel, is_finger

_TURNS = 36  # candidates of a frame, 10 degrees apart
# Points that keep their place on a standing body, by parts of their names.
_STEADY = (
    "hip",
    "shoulder",
    "collar",
    "pelvis",
    "spine",
    "neck",
    "head",
    "nose",
    "eye",
    "ear",
    "knee",
    "ankle",
    "heel",
)
_FACE = ("nose", "left_eye", "right_eye", "face_30")


@dataclass(frozen=True, eq=False)
class Turns:
    """Candidate headings of the body in every frame.

    Attributes:
        cost: mean truncated error of each candidate, from 0 to about 1.
        transl: translation of the body that projects best, metres.
    """

    cost: Float64[np.ndarray, "T A"]
    transl: Float64[np.ndarray, "T A 3"]


def standing_state(kinematics: Kinematics, frames: int, *, arms_down: float = 40.0) -> BodyState:
    """Return the mean shape in the T-pose with arms lowered by some degrees, in all frames."""
    body = kinematics.body
    rotations = np.tile(np.eye(3), (frames, body.joint_count, 1, 1))
    names = list(body.joint_names)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        lowered = np.radians([0.0, 0.0, sign * arms_down])
        rotations[:, names.index(f"{side}_shoulder")] = matrix_from_rotvec(lowered)
    return BodyState(
        rotations, np.zeros((frames, 3)), np.zeros(body.num_betas), np.zeros((frames, body.num_expressions))
    )


def start_of_turn(
    kinematics: Kinematics,
    camera: Camera,
    landmarks: LandmarkModel,
    keypoints: Keypoints2D,
    up: Float[np.ndarray, " 3"],
) -> tuple[BodyState, float]:
    """Return a state that stands, faces and is placed as the keypoints of each frame say, and its mean cost.

    Args:
        kinematics: of the body.
        camera: that stands still.
        landmarks: the named points of the body.
        keypoints: with the names of `landmarks`, a row a frame.
        up: unit vector of the vertical, in world coordinates.
    """
    turns = candidate_turns(kinematics, camera, landmarks, keypoints, up)
    path, cost = best_path(turns.cost)
    state = standing_state(kinematics, len(keypoints.frames))
    root = int(np.flatnonzero(kinematics.parents < 0)[0])
    state.rotations[:, root] = _turned(up)[path]
    state.transl[:] = turns.transl[np.arange(len(path)), path]
    return state, cost


def candidate_turns(
    kinematics: Kinematics,
    camera: Camera,
    landmarks: LandmarkModel,
    keypoints: Keypoints2D,
    up: Float[np.ndarray, " 3"],
) -> Turns:
    """Place the body in every candidate turn of every frame, and measure how well its points project."""
    body = kinematics.body
    posed = body.forward(standing_state(kinematics, 1).to_params(body))
    points = landmarks.points(posed.vertices[0], posed.joints[0])
    steady = [any(part in name for part in _STEADY) and not is_finger(name) for name in landmarks.names]
    root = kinematics.rest_joints[np.flatnonzero(kinematics.parents < 0)[0]]
    rotations = _turned(up)
    turned = (points - root) @ rotations.transpose(0, 2, 1) + root  # (A, K, 3), about the root
    # In the camera's axes the translation t solves `x + t_x = u (z + t_z)`, with u the pixel on the plane z = 1.
    R, offset = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    inside = turned @ R.T + offset
    plane = (keypoints.points - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    confidence = keypoints.confidence * np.asarray(steady)
    cost = np.full((len(plane), _TURNS), np.inf)
    transl = np.zeros((len(plane), _TURNS, 3))
    facing = _facing(rotations, R)
    for row, (seen, weight) in enumerate(zip(plane, confidence, strict=True)):
        if (weight > 0).sum() < 4:
            cost[row] = 0.0
            continue
        extent = np.ptp(seen[weight > 0], axis=0).max()
        move, off = _placed(inside, seen, weight, cutoff=0.04 * extent)
        cost[row] = off + _face_cost(facing, landmarks.names, keypoints.confidence[row])
        cost[row, move[:, 2] + inside[:, :, 2].mean(axis=1) < 0.3] += 10.0  # behind the camera
        transl[row] = move @ R  # camera's axes to the world's
    return Turns(cost, transl)


def best_path(cost: Float64[np.ndarray, "T A"]) -> tuple[Int64[np.ndarray, " T"], float]:
    """Return the candidates of least cost through the frames, and their mean cost.

    A step costs `0.3 min((d / 45 degrees)^2, 4)`, with d its difference from an equal share of one whole turn; both
    senses of the turn are tried. The cost is bounded, because people pause, and photographs are taken unevenly.
    """
    count, turns = cost.shape
    degrees = 360.0 / turns * np.arange(turns)
    found = []
    for sense in (1.0, -1.0):
        off = degrees[None, :] - degrees[:, None] - sense * 360.0 / max(count, 2)
        off = (off + 180.0) % 360.0 - 180.0
        step = 0.3 * np.minimum((off / 45.0) ** 2, 4.0)
        total, back = cost[0], []
        for row in cost[1:]:
            through = total[:, None] + step
            back.append(through.argmin(axis=0))
            total = through.min(axis=0) + row
        path = [int(total.argmin())]
        for before in reversed(back):
            path.append(int(before[path[-1]]))
        found.append((float(total.min()), path[::-1]))
    least, path = min(found, key=lambda one: one[0])
    return np.array(path), least / count


def _turned(up: np.ndarray) -> Float64[np.ndarray, "A 3 3"]:
    """Return rotations by whole steps about the vertical, applied to a body that stands along it."""
    y = np.array([0.0, 1.0, 0.0])
    axis, cosine = np.cross(y, up), float(np.clip(y @ up, -1.0, 1.0))
    sine = np.linalg.norm(axis)
    tilt = matrix_from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, cosine))
    turn = np.zeros((_TURNS, 3))
    turn[:, 1] = 2 * np.pi / _TURNS * np.arange(_TURNS)
    return tilt @ matrix_from_rotvec(turn)


def _facing(rotations: np.ndarray, camera_rotation: np.ndarray) -> Float64[np.ndarray, " A"]:
    """Return the cosine between the direction in which each candidate looks and that to the camera."""
    return -(rotations[:, :, 2] @ camera_rotation.T)[:, 2]


def _face_cost(facing: np.ndarray, names: tuple[str, ...], confidence: np.ndarray) -> Float64[np.ndarray, " A"]:
    """Return a cost from 0 to 0.5: points of the face that are seen from behind, or are not from the front."""
    rows = [k for k, name in enumerate(names) if name in _FACE]
    if not rows:
        return np.zeros(len(facing))
    # Confidence from which a point counts as detected.
    seen = 0.3
    share = float(np.mean(confidence[rows] > seen))
    return 0.5 * (share * np.clip(-facing - 0.2, 0.0, 0.5) + (1.0 - share) * np.clip(facing - 0.2, 0.0, 0.5)) / 0.5


def _placed(
    inside: Float64[np.ndarray, "A K 3"], seen: Float64[np.ndarray, "K 2"], weight: np.ndarray, *, cutoff: float
) -> tuple[Float64[np.ndarray, "A 3"], Float64[np.ndarray, " A"]]:
    """Return the translations that project points best, and the weighted mean of their truncated squared errors.

    Six rounds of linear least squares with the weights of Geman and McClure, of a scale that falls to the cutoff.
    """
    move = np.zeros((len(inside), 3))
    robust = np.ones(inside.shape[:2])
    squared = np.zeros_like(robust)
    for scale in (16.0, 8.0, 4.0, 2.0, 1.0, 1.0):
        # Rows `t_x - u t_z = u z - x` and the same for y, divided by the depth, which turns them into image distances.
        depth = np.maximum(inside[..., 2] + move[:, None, 2], 0.3) if scale < 16.0 else np.ones_like(robust)
        w = weight * robust / depth**2
        A = np.zeros((*robust.shape, 2, 3))
        A[..., 0, 0] = A[..., 1, 1] = 1.0
        A[..., 2] = -seen[None]
        b = seen[None] * inside[..., 2:] - inside[..., :2]
        normal = np.einsum("ak,akic,akid->acd", w, A, A) + 1e-9 * np.eye(3)
        move = np.linalg.solve(normal, np.einsum("ak,akic,aki->ac", w, A, b)[..., None])[..., 0]
        moved = inside + move[:, None]
        projected = moved[..., :2] / np.maximum(moved[..., 2:], 0.1)
        squared = ((projected - seen) ** 2).sum(axis=2) / cutoff**2
        robust = 1.0 / (1.0 + squared / scale**2) ** 2
    return move, (weight * np.minimum(squared, 1.0)).sum(axis=1) / weight.sum()
