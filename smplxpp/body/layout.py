"""List the joints of the SMPL family and the orders in which detectors list their keypoints.

An order holds a name of `Keypoints2D` for each point, or None for a point that has no name here: necks and midpoints of
hips (OpenPose's are midpoints of other points), tops of heads, pupils, the contour of the face, roots of hands (the
wrist is listed already), and the inner and outer corners of eyes and mouth of MediaPipe's pose.

Sources: OpenPose, `src/openpose/pose/poseParameters.cpp` (POSE_BODY_25_BODY_PARTS, POSE_BODY_25B_BODY_PARTS,
POSE_BODY_135_BODY_PARTS) and its `doc/02_output.md` (hands, face); COCO (Lin et al. 2014); COCO-WholeBody (Jin et al.
2020) and Halpe (AlphaPose, Fang et al. 2022) as in mmpose's `configs/_base_/datasets/coco_wholebody.py`, `halpe26.py`
and `halpe.py`; MediaPipe's lists of pose, hand and face landmarks; the vertices of its face mesh (Kartynnik et al.
2019) at dlib's points as in P. Yan's Mediapipe_2_Dlib_Landmarks.
"""

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
