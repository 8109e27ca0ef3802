"""Joints of the SMPL family: their names, their order, and which parameters turn them."""

from __future__ import annotations

from smplxpp.core.params import POSE_BLOCKS

_BODY = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot "
    "neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist"
).split()
_FACE = ["jaw", "left_eye_smplhf", "right_eye_smplhf"]
# The order of the fingers is the models' own: pinky before ring.
_HANDS = [
    f"{side}_{finger}{bone}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for bone in (1, 2, 3)
]

SMPLX_JOINTS: tuple[str, ...] = tuple(_BODY + _FACE + _HANDS)
SMPLH_JOINTS: tuple[str, ...] = tuple(_BODY + _HANDS)
SMPL_JOINTS: tuple[str, ...] = (*_BODY, "left_hand", "right_hand")

# Families by their number of joints: the names, and the parameters that turn them in order. SMPL's two hand joints
# have no parameter here and stay at rest.
JOINT_NAMES: dict[int, tuple[str, ...]] = {len(names): names for names in (SMPLX_JOINTS, SMPLH_JOINTS, SMPL_JOINTS)}
POSE_NAMES: dict[int, tuple[str, ...]] = {
    55: tuple(name for name, _ in POSE_BLOCKS),
    52: ("global_orient", "body_pose", "left_hand_pose", "right_hand_pose"),
    24: ("global_orient", "body_pose"),
}
HAND_WIDTH = 45
