"""Poses that try a template's skinning: each bends what clothes find hard.

Angles follow SMPL-X's T-pose (x to the subject's left, y up, z to the front; joint frames are the world's axes).
"""

from __future__ import annotations

import numpy as np

from smplxpp.core.params import BodyParams

# Joint index in SMPL-X order -> axis-angle in degrees.
_L_HIP, _R_HIP, _SPINE1, _L_KNEE, _R_KNEE, _SPINE2, _L_ANKLE, _R_ANKLE, _SPINE3 = 1, 2, 3, 4, 5, 6, 7, 8, 9
_NECK, _L_COLLAR, _R_COLLAR, _HEAD, _L_SHOULDER, _R_SHOULDER, _L_ELBOW, _R_ELBOW = 12, 13, 14, 15, 16, 17, 18, 19

STRESS_POSES: dict[str, dict[int, tuple[float, float, float]]] = {
    "squat": {
        _L_HIP: (-95, 0, 15),
        _R_HIP: (-95, 0, -15),
        _L_KNEE: (110, 0, 0),
        _R_KNEE: (110, 0, 0),
        _L_ANKLE: (-25, 0, 0),
        _R_ANKLE: (-25, 0, 0),
        _SPINE1: (15, 0, 0),
        _SPINE2: (10, 0, 0),
        _L_SHOULDER: (0, -60, -20),
        _R_SHOULDER: (0, 60, 20),
    },
    "high_step": {
        _L_HIP: (-90, 0, 5),
        _L_KNEE: (95, 0, 0),
        _R_HIP: (10, 0, 0),
        _L_SHOULDER: (0, 0, -60),
        _R_SHOULDER: (0, 0, 60),
        _R_ELBOW: (0, 60, 0),
    },
    "arms_overhead": {
        _L_COLLAR: (0, 0, 20),
        _R_COLLAR: (0, 0, -20),
        _L_SHOULDER: (0, 0, 60),
        _R_SHOULDER: (0, 0, -60),
        _L_ELBOW: (0, 0, 10),
        _R_ELBOW: (0, 0, -10),
    },
    "twist": {
        _SPINE1: (0, 15, 0),
        _SPINE2: (0, 20, 0),
        _SPINE3: (0, 15, 0),
        _NECK: (0, 15, 0),
        _HEAD: (0, 20, 0),
        _L_SHOULDER: (0, 0, -65),
        _R_SHOULDER: (0, 0, 65),
    },
}


def stress_poses(reference: BodyParams) -> BodyParams:
    """The poses of `STRESS_POSES`, in order, with the identity of `reference` (its first frame), face neutral.

    Returns:
        BodyParams of `len(STRESS_POSES)` frames, root at the reference's translation, hands relaxed (zero).
    """
    first = reference.frame(0)
    count = len(STRESS_POSES)
    pose = np.zeros((count, 55, 3))
    for row, joints in enumerate(STRESS_POSES.values()):
        for joint, degrees in joints.items():
            pose[row, joint] = np.radians(degrees)
    return BodyParams.from_full_pose(
        pose,
        betas=np.repeat(first.betas, count, axis=0),
        expression=np.zeros((count, first.expression.shape[1])),
        transl=np.repeat(first.transl, count, axis=0),
    )
