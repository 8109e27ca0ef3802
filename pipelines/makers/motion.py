"""The fixture person's motion: a relaxed A-pose, gestures, a step, a twist, arms overhead; and a tracker's noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.makers.anny_base import JOINT_NAMES
from smplxpp.core.params import POSE_BLOCKS, BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix

FRAMES_PER_KEY = 4
FPS = 10.0

# Degrees a joint, axis-angle in the T-pose's world axes (x to the subject's left, y up, z to the front).
_RELAXED = {
    "left_collar": (0, 0, -4), "right_collar": (0, 0, 4),
    "left_shoulder": (0, -6, -46), "right_shoulder": (0, 6, 46),
    "left_elbow": (0, -14, 0), "right_elbow": (0, 14, 0),
}  # fmt: skip
_KEY_POSES: tuple[dict[str, tuple[float, float, float]], ...] = (
    {},
    {  # talks with both hands
        "left_shoulder": (10, -40, -52), "right_shoulder": (10, 40, 52),
        "left_elbow": (-20, -70, 10), "right_elbow": (-10, 55, -5), "head": (5, 10, 0),
    },
    {  # points to the left, looks there
        "left_shoulder": (0, -25, -8), "left_elbow": (0, -10, 0), "head": (0, 28, 0), "spine3": (0, 12, 0),
        "neck": (0, 8, 0),
    },
    {  # a step with the left leg
        "left_hip": (-42, 0, 3), "left_knee": (50, 0, 0), "right_hip": (12, 0, 0), "left_ankle": (-6, 0, 0),
        "right_shoulder": (0, 35, 50), "left_shoulder": (0, 12, -50),
    },
    {  # a twist to the right
        "spine1": (0, -12, 0), "spine2": (0, -16, 0), "spine3": (0, -14, 0), "head": (0, -15, 0),
        "left_shoulder": (0, -45, -40), "right_shoulder": (0, -15, 50),
    },
    {  # both arms overhead
        "left_collar": (0, 0, 18), "right_collar": (0, 0, -18), "left_shoulder": (0, 0, 55),
        "right_shoulder": (0, 0, -55), "left_elbow": (0, -8, 8), "right_elbow": (0, 8, -8),
    },
)  # fmt: skip
_KEY_FACES: tuple[dict[str, float], ...] = (
    {},
    {"jawOpen": 0.35, "mouthFunnel": 0.2},
    {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7, "cheekSquintLeft": 0.3, "cheekSquintRight": 0.3},
    {"browInnerUp": 0.5, "jawOpen": 0.15},
    {"eyeBlinkLeft": 0.9, "eyeBlinkRight": 0.9},
    {"jawOpen": 0.5, "browOuterUpLeft": 0.6, "browOuterUpRight": 0.6},
)


def person_motion(betas: np.ndarray, expression_names: tuple[str, ...]) -> BodyParams:
    """Frame 0 is the A-pose with a neutral face; the key poses follow each other in smooth steps. transl is zero."""
    poses = np.stack([_pose(_RELAXED | key) for key in _KEY_POSES])
    faces = np.array([[key.get(name, 0.0) for name in expression_names] for key in _KEY_FACES])
    time = np.linspace(0, len(poses) - 1, FRAMES_PER_KEY * len(poses))
    before = np.minimum(time.astype(int), len(poses) - 2)
    t = time - before
    t = (t * t * (3 - 2 * t))[:, None]
    pose = (1 - t[..., None]) * poses[before] + t[..., None] * poses[before + 1]
    return BodyParams.from_full_pose(
        pose,
        betas=np.repeat(betas[None], len(time), axis=0),
        expression=(1 - t) * faces[before] + t * faces[before + 1],
        transl=np.zeros((len(time), 3)),
        fps=FPS,
    )


def tracker_noise(
    params: BodyParams, *, seed: int, degrees: float = 1.5, transl: float = 0.008, expression: float = 0.04,
    betas: float = 0.12,
) -> BodyParams:  # fmt: skip
    """Parameters as a tracker would give them; standard deviations of each joint's turn about each axis, of each
    coordinate in metres (half white, half slow), of expression weights, and of one constant offset of betas."""
    rng = np.random.default_rng(seed)
    count = len(params)
    turns = matrix_from_rotvec(rng.normal(0, np.radians(degrees), (count, len(JOINT_NAMES), 3)))
    pose = rotvec_from_matrix(turns @ matrix_from_rotvec(params.full_pose))
    phase = rng.uniform(0, 2 * np.pi, 3) + 2 * np.pi * np.arange(count)[:, None] / max(count, 2)
    slow, white = np.sin(phase) * np.sqrt(2), rng.normal(size=(count, 3))
    blocks = BodyParams.from_full_pose(
        pose,
        betas=params.betas + rng.normal(0, betas, params.betas.shape[1]),
        expression=np.clip(params.expression + rng.normal(0, expression, params.expression.shape), 0, 1),
        transl=params.transl + transl * np.sqrt(0.5) * (slow + white),
    )
    return replace(params, **blocks.as_dict())


def _pose(degrees: dict[str, tuple[float, float, float]]) -> np.ndarray:
    """(55, 3) axis-angle; fingers a little bent."""
    pose = np.zeros((sum(joints for _, joints in POSE_BLOCKS), 3))
    for j, name in enumerate(JOINT_NAMES):
        if name[-1].isdigit() and not name.startswith("spine") and "thumb" not in name:
            pose[j, 2] = -12.0 if name.startswith("left") else 12.0
    for name, angles in degrees.items():
        pose[JOINT_NAMES.index(name)] = angles
    return np.radians(pose)
