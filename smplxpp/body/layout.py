"""List the joints of the SMPL family, other programs' names for them, and the orders of detectors' keypoints.

An order holds a name of `Keypoints2D` for each point, or None for a point that has no name here: necks and midpoints of
hips (OpenPose's are midpoints of other points), tops of heads, pupils, the contour of the face, roots of hands (the
wrist is listed already), and the inner and outer corners of eyes and mouth of MediaPipe's pose.

Sources: OpenPose, `src/openpose/pose/poseParameters.cpp` (POSE_BODY_25_BODY_PARTS, POSE_BODY_25B_BODY_PARTS,
POSE_BODY_135_BODY_PARTS) and its `doc/02_output.md` (hands, face); COCO (Lin et al. 2014); COCO-WholeBody (Jin et al.
2020) and Halpe (AlphaPose, Fang et al. 2022) as in mmpose's `configs/_base_/datasets/coco_wholebody.py`, `halpe26.py`
and `halpe.py`; MediaPipe's lists of pose, hand and face landmarks; the vertices of its face mesh (Kartynnik et al.
2019) at dlib's points as in P. Yan's Mediapipe_2_Dlib_Landmarks. Programs: Mixamo's automatic rig; Unity's enumeration
`HumanBodyBones`; Unreal's `SK_Mannequin` (Manny has two more joints of the spine and one more of the neck); VRM 1.0.
"""

from __future__ import annotations

from collections.abc import Sequence

from smplxpp.core.errors import InputError, require_choice
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

# Families by their number of joints: names, and the parameters that rotate the joints, in order. SMPL's two hand joints
# have no parameter here and stay at rest.
JOINT_NAMES: dict[int, tuple[str, ...]] = {len(names): names for names in (SMPLX_JOINTS, SMPLH_JOINTS, SMPL_JOINTS)}
POSE_NAMES: dict[int, tuple[str, ...]] = {
    55: tuple(name for name, _ in POSE_BLOCKS),
    52: ("global_orient", "body_pose", "left_hand_pose", "right_hand_pose"),
    24: ("global_orient", "body_pose"),
}
HAND_WIDTH = 45
"""Numbers of a hand's pose: axis-angle vectors of 15 joints."""

Order = tuple[str | None, ...]

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
FACE: Order = tuple(f"face_{k}" for k in range(17, 68))
_SPLIT = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def _named(words: str) -> Order:
    """Expand `L_hip` to `coco_left_hip` and `L_ear` to `left_ear`; `-` becomes None, names without a side stay."""
    sides, out = {"L": "left", "R": "right"}, []
    for word in words.split():
        side, _, part = word.partition("_")
        if side not in sides:
            out.append(None if word == "-" else word)
        else:
            out.append(("coco_" if part in _SPLIT else "") + f"{sides[side]}_{part}")
    return tuple(out)


def _hand(side: str, *, root: bool) -> Order:
    """List a hand from thumb to pinky, each finger from its knuckle to its tip.

    The first joint of the models' thumb is at the carpus, as that of the detectors is.
    """
    points = [f"{side}_{finger}{joint}" for finger in FINGERS for joint in ("1", "2", "3", "_tip")]
    return (*([None] if root else []), *points)


COCO_17 = _named(
    "nose L_eye R_eye L_ear R_ear L_shoulder R_shoulder L_elbow R_elbow L_wrist R_wrist L_hip R_hip L_knee R_knee "
    "L_ankle R_ankle"
)
BODY_25 = _named(
    "nose - R_shoulder R_elbow R_wrist L_shoulder L_elbow L_wrist - R_hip R_knee R_ankle L_hip L_knee L_ankle R_eye "
    "L_eye R_ear L_ear L_big_toe L_small_toe L_heel R_big_toe R_small_toe R_heel"
)
_FEET = _named("L_big_toe L_small_toe L_heel R_big_toe R_small_toe R_heel")
BODY_25B: Order = (*COCO_17, None, None, *_FEET)
# dlib's 68 points, and OpenPose's 70 with pupils.
FACE_68: Order = (*(None,) * 17, *FACE)
FACE_70: Order = (*FACE_68, None, None)
LEFT_HAND, RIGHT_HAND = _hand("left", root=True), _hand("right", root=True)
BODY_135: Order = (*BODY_25B, *_hand("left", root=False), *_hand("right", root=False), *FACE_70)
WHOLE_BODY_133: Order = (*COCO_17, *_FEET, *FACE_68, *LEFT_HAND, *RIGHT_HAND)
HALPE_26: Order = (
    *COCO_17,
    *_named("- - - L_big_toe R_big_toe L_small_toe R_small_toe L_heel R_heel"),  # after head, neck and hip
)
HALPE_136: Order = (*HALPE_26, *FACE_68, *LEFT_HAND, *RIGHT_HAND)
MEDIAPIPE_POSE = _named(
    "nose - L_eye - - R_eye - L_ear R_ear - - L_shoulder R_shoulder L_elbow R_elbow L_wrist R_wrist - - - - - - L_hip "
    "R_hip L_knee R_knee L_ankle R_ankle L_heel R_heel L_big_toe R_big_toe"
)

# Vertices of MediaPipe's face mesh (468, or 478 with irises) at dlib's points 17 to 67; two vertices stand for their
# midpoint.
MEDIAPIPE_FACE: tuple[tuple[int, ...], ...] = (
    *((k,) for k in (70, 63, 105, 66, 107)),  # right brow, from the outside
    *((k,) for k in (336, 296, 334, 293, 300)),  # left brow, from the inside
    *((168, 6), (197, 195), (5,), (4,)),  # bridge of the nose
    *((k,) for k in (98, 97, 2, 326, 327)),  # nostrils, from the right
    *((k,) for k in (33, 160, 158, 133, 153, 144)),  # right eye
    *((k,) for k in (362, 385, 387, 263, 373, 380)),  # left eye
    *((k,) for k in (61, 39, 37, 0, 267, 269, 291, 321, 314, 17, 84, 91)),  # lips, outside
    *((k,) for k in (78, 82, 13, 312, 308, 317, 14, 87)),  # lips, inside
)

# Orders by their number of points. OpenPose's BODY_25 and BODY_25B have equal numbers; the format's name decides.
BY_COUNT: dict[int, Order] = {
    17: COCO_17,
    25: BODY_25,
    26: HALPE_26,
    133: WHOLE_BODY_133,
    135: BODY_135,
    136: HALPE_136,
}

VOCABULARY: frozenset[str] = frozenset(SMPLX_JOINTS) | {
    name for order in (*BY_COUNT.values(), BODY_25B, MEDIAPIPE_POSE) for name in order if name is not None
}

OWN_NAMES = "smplx"
"""The scheme that keeps the body's own names."""
PROGRAMS = ("mixamo", "unity", "unreal", "vrm")
NAME_SCHEMES = (OWN_NAMES, *PROGRAMS)
"""Whose names a file's joints can have."""

# A joint a line: our name, then those of `PROGRAMS`. Joints of the left side stand for both; - where there is none.
_JOINTS = """
pelvis            Hips          Hips          pelvis      hips
spine1            Spine         Spine         spine_01    spine
spine2            Spine1        Chest         spine_02    chest
spine3            Spine2        UpperChest    spine_03    upperChest
neck              Neck          Neck          neck_01     neck
head              Head          Head          head        head
jaw               -             Jaw           -           jaw
left_eye_smplhf   LeftEye       LeftEye       -           leftEye
left_collar       LeftShoulder  LeftShoulder  clavicle_l  leftShoulder
left_shoulder     LeftArm       LeftUpperArm  upperarm_l  leftUpperArm
left_elbow        LeftForeArm   LeftLowerArm  lowerarm_l  leftLowerArm
left_wrist        LeftHand      LeftHand      hand_l      leftHand
left_hip          LeftUpLeg     LeftUpperLeg  thigh_l     leftUpperLeg
left_knee         LeftLeg       LeftLowerLeg  calf_l      leftLowerLeg
left_ankle        LeftFoot      LeftFoot      foot_l      leftFoot
left_foot         LeftToeBase   LeftToes      ball_l      leftToes
"""
# The bones of a finger from the hand on: all of Unity's and four of VRM's, whose thumb starts at the carpus.
_BONES = ("Proximal", "Intermediate", "Distal")
_THUMB = ("Metacarpal", "Proximal", "Distal")


def _program_names() -> dict[str, dict[str, str]]:
    """Return the name of each of our joints by program."""
    rows = [line.split() for line in _JOINTS.strip().splitlines()]
    for finger in FINGERS:
        called = "Little" if finger == "pinky" else finger.title()
        for k, bone in enumerate(_BONES, start=1):
            vrm = (_THUMB if finger == "thumb" else _BONES)[k - 1]
            rows.append(
                [
                    f"left_{finger}{k}",
                    f"LeftHand{finger.title()}{k}",
                    f"Left{called}{bone}",
                    f"{finger}_0{k}_l",
                    f"left{called}{vrm}",
                ]
            )
    rows += [[_mirrored(name) for name in row] for row in rows if row[0].startswith("left_")]
    return {
        program: {row[0]: row[column] for row in rows if row[column] != "-"}
        for column, program in enumerate(PROGRAMS, start=1)
    }


def _mirrored(name: str) -> str:
    """Return the name of the joint on the right."""
    if name.endswith("_l"):
        return f"{name[:-2]}_r"
    return name.replace("left", "right", 1).replace("Left", "Right", 1)


PROGRAM_NAMES = _program_names()
"""By program, the name of each of our joints that it knows; Mixamo's without the prefix of its name space."""
_PREFIXES = {"mixamo": "mixamorig:"}
"""Name space before the names of a program."""


def names_of_joints(joint_names: Sequence[str], scheme: str) -> tuple[str, ...]:
    """Return the names that a program gives to joints; a joint that it has no name for keeps its own.

    Args:
        joint_names: of the body, as SMPL-X calls them.
        scheme: one of `NAME_SCHEMES`.

    Raises:
        InputError: another scheme, or a body without any joint of the SMPL family.

    Example:
        >>> from smplxpp.body.layout import names_of_joints
        >>> names_of_joints(["pelvis", "left_hip", "jaw"], "mixamo")
        ('mixamorig:Hips', 'mixamorig:LeftUpLeg', 'jaw')
    """
    require_choice("joint names", scheme, NAME_SCHEMES)
    if scheme == OWN_NAMES:
        return tuple(joint_names)
    if not set(joint_names) & set(SMPLX_JOINTS):
        raise InputError(
            "joint names",
            expected=f"joints of the SMPL family, to name them as {scheme} does",
            received=", ".join(joint_names[:3]),
            remedy=f"keep the body's own with {OWN_NAMES!r}",
        )
    prefix, known = _PREFIXES.get(scheme, ""), PROGRAM_NAMES[scheme]
    return tuple(f"{prefix}{known[name]}" if name in known else name for name in joint_names)
