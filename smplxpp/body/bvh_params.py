"""Convert a BVH motion to parameters of a body: match joint names and account for its own rest pose."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body.bvh import BvhMotion, read_bvh
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.retarget import FEET, Skeleton, held_feet
from smplxpp.core import BodyParams, GeometryWarning, InputError, rotvec_from_matrix
from smplxpp.core.files.json_file import as_object, as_text, read_json

_FINGERS = SMPLX_JOINTS[25:]
OURS = (*SMPLX_JOINTS[:22], *_FINGERS)
"""Joints that a motion can rotate: those of the body and of the fingers."""
_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow")
NEEDED = ("pelvis", *(f"{side}_{name}" for side in ("left", "right") for name in _LIMBS))
# Names that other programs use for our joints, in lower case without blanks, dashes and prefixes; `S` stands for left
# or right, or l or r. The first name that a file has is taken.
_MIDDLE = {
    "pelvis": "hips hip pelvis root bip01 bip01pelvis",
    "spine1": "spine lowerback spine01 abdomen bip01spine chest torso",
    "spine2": "spine1 spine02 chest2 bip01spine1 chestlower",
    "spine3": "spine2 spine03 chest3 upperchest bip01spine2 chestupper chest4",
    "neck": "neck neck1 neck01 bip01neck",
    "head": "head bip01head",
}
_SIDES = {
    "hip": "Supleg Shipjoint Sthigh thighS Supperleg Ship",
    "knee": "Sleg Sshin calfS Slowleg Slowerleg Sknee Scalf",
    "ankle": "Sankle Sfoot footS",
    "foot": "Stoebase Stoe ballS Stoes Stoe0 Sball Sfoot footS",
    "collar": "Scollar clavicleS Sclavicle Sshoulder",
    "shoulder": "Sarm Sshldr upperarmS Suparm Supperarm Sshoulder",
    "elbow": "Sforearm lowerarmS Slowarm Slowerarm Selbow",
    "wrist": "Swrist Shand handS",
}
# Bones of a finger are numbered from the hand: in the patterns of Mixamo and CMU, Unreal, Poser, and DAZ.
_FINGER_NAMES = {
    "index": ["index"],
    "middle": ["middle", "mid"],
    "pinky": ["pinky", "little"],
    "ring": ["ring"],
    "thumb": ["thumb"],
}
_FINGER_PATTERNS = ("Shand{finger}{bone}", "{finger}0{bone}S", "S{finger}{bone}", "{finger}{bone}S")
_SIDE_NAMES = {"left": ("left", "l"), "right": ("right", "r")}
_FRAME = ("left_hip", "right_hip", "left_shoulder", "right_shoulder", "neck")
_CHILD = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
_STRETCH = 0.02  # largest change of a bone's length, as a share: the rounding of files is below
_CHILD |= {f"{finger}{bone}": f"{finger}{bone + 1}" for finger in _FINGER_NAMES for bone in (1, 2)}


def load_bvh(path: str | Path, body: Skeleton, *, joint_map: Mapping[str, str] | None = None) -> BodyParams:
    """Read a BVH motion for a body: limbs point where the file's do, and steps are scaled by the length of the legs.

    Args:
        path: of the file.
        body: skeleton that shall move.
        joint_map: our name for each of the file's names; None for the known names.

    Raises:
        InputError: what `read_bvh` refuses, or required joints that are missing.

    Warns:
        GeometryWarning: bones below the pelvis that change their length.
    """
    motion = read_bvh(path)
    found = named_joints(motion.names, joint_map, parents=motion.parents, subject=f"motion {path}")
    _warn_of_stretching(motion, found, str(path))
    return bvh_params(motion, found, body)


def _warn_of_stretching(motion: BvhMotion, joints: Mapping[str, int], source: str) -> None:
    """Warn of bones below the pelvis that change their length, which a body's cannot."""
    above, joint = set(), joints["pelvis"]
    while joint >= 0:
        above.add(joint)
        joint = int(motion.parents[joint])
    changed = {}
    for joint, place in motion.positions.items():
        length = float(np.linalg.norm(motion.offsets[joint]))
        most = float(np.linalg.norm(place - motion.offsets[joint], axis=1).max())
        if joint not in above and most > _STRETCH * length:
            changed[motion.names[joint]] = 100.0 * most / max(length, 1e-9)
    if changed:
        worst = max(changed, key=lambda name: changed[name])
        warnings.warn(
            f"{source}: {len(changed)} bones move against their parents, {worst} most, by up to {changed[worst]:.0f} % "
            "of its length: the body's bones keep theirs, and follow the turns alone",
            GeometryWarning,
            stacklevel=3,
        )


def read_joint_map(path: str | Path) -> dict[str, str]:
    """Read a JSON object with our name for each joint of another skeleton: `{"LeftUpLeg": "left_hip", ...}`.

    Raises:
        InputError: a damaged file, or a joint that a body does not have.
    """
    subject = f"joint map {path}"
    values = as_object(read_json(path, subject="joint map"), subject=subject)
    for theirs, ours in values.items():
        if as_text(ours, subject=f"{subject}: {theirs}") not in OURS:
            raise InputError(f"{subject}: {theirs}", expected=f"one of {', '.join(OURS)}", received=repr(ours)[:80])
    return values


def named_joints(
    names: tuple[str, ...],
    joint_map: Mapping[str, str] | None,
    *,
    parents: Sequence[int] | Int64[np.ndarray, " J"] = (),
    subject: str = "motion",
) -> dict[str, int]:
    """Return the index of the file's joint for each of our joints that it has.

    Args:
        names: the file's joints.
        joint_map: our name for each of the file's names; None for the names that other programs use.
        parents: index of each joint's parent, -1 for the root. With it the spine is read off the skeleton, because
            programs count its joints from 0, from 1, or not at all. Empty: names decide.
        subject: the file, for messages.

    Raises:
        InputError: a required joint is missing.
    """
    # A map of the user decides alone; else our own names, which our writer uses; else the names of other programs.
    if joint_map is not None:
        unknown = [name for name in joint_map if name not in names]
        if unknown:
            raise InputError(
                f"{subject}: joint map", expected=f"names of {', '.join(names)}"[:600], received=unknown[0]
            )
        found = {ours: names.index(theirs) for theirs, ours in joint_map.items()}
    elif all(name in names for name in NEEDED):
        found = {name: names.index(name) for name in OURS if name in names}
    else:
        found = _known(names)
        found |= _spine(found, parents)
    missing = [name for name in NEEDED if name not in found]
    if missing:
        raise InputError(
            f"{subject}: joints",
            expected=f"joints that stand for {', '.join(NEEDED)}",
            received=f"none for {', '.join(missing)}, among {', '.join(names)}"[:600],
            remedy='name them with --joint-map FILE, JSON as {"LeftUpLeg": "left_hip", ...}',
        )
    return found


def _known(names: tuple[str, ...]) -> dict[str, int]:
    """Match joints by the names that other programs use."""
    # Names without name space ("mixamorig:"), separators and case.
    plain = [re.sub(r"[\s_.\-]", "", re.sub(r"^.*[:|]", "", name).lower()) for name in names]
    found: dict[str, int] = {}

    def take(ours: str, words: list[str]) -> None:
        for word in words:
            if word in plain and plain.index(word) not in found.values():
                found[ours] = plain.index(word)
                return

    for ours, words in _MIDDLE.items():
        take(ours, words.split())
    for side, spoken in _SIDE_NAMES.items():
        # The shoulder comes first: a joint of that name is a collar if the file also has an arm.
        for part in ("shoulder", *(name for name in _SIDES if name != "shoulder")):
            take(f"{side}_{part}", [word.replace("S", one) for one in spoken for word in _SIDES[part].split()])
        for finger, called in _FINGER_NAMES.items():
            for bone in (1, 2, 3):
                patterns = [p.format(finger=one, bone=bone) for one in called for p in _FINGER_PATTERNS]
                take(f"{side}_{finger}{bone}", [p.replace("S", one) for one in spoken for p in patterns])
    return found


def _spine(found: Mapping[str, int], parents: Sequence[int] | Int64[np.ndarray, " J"]) -> dict[str, int]:
    """Return the first, a middle and the last of the three or more joints between pelvis and neck; else none."""
    if not len(parents) or not {"pelvis", "neck"} <= found.keys():
        return {}
    chain, joint = [], int(parents[found["neck"]])
    while joint >= 0 and joint != found["pelvis"]:
        chain.append(joint)
        joint = int(parents[joint])
    if joint < 0 or len(chain) < 3:
        return {}
    chain.reverse()
    return {"spine1": chain[0], "spine2": chain[len(chain) // 2], "spine3": chain[-1]}


def bvh_params(motion: BvhMotion, joints: Mapping[str, int], body: Skeleton) -> BodyParams:
    """Return the parameters of a body that moves as the skeleton does.

    A joint's rotation in world coordinates is the file's, times the rotation from our rest pose to the file's. For
    hips, knees, shoulders, elbows and fingers this is the smallest rotation between the directions of their bones; for
    all others it is the rotation between the trunks. So arms that hang in the file's rest pose hang here too. Fingers
    that the file lacks follow their hands or, if it has none at all, stay at rest. Translations are scaled by the ratio
    of the legs' lengths, which also converts units. The lowest foot is put at the height of the feet at rest, and the
    first frame above the origin.
    """
    # Rotations of the file in world coordinates, and the rotations between both rest poses.
    world = _in_world(motion)
    rest = motion.rest
    trunk = _trunk(rest, joints, body)
    upright = _upright(rest, joints)
    pose = np.zeros((len(world), len(SMPLX_JOINTS), 3))
    away: dict[str, Float64[np.ndarray, "3 3"]] = {}
    whole: dict[str, Float64[np.ndarray, "T 3 3"]] = {}
    # Parents before children; without a face, and fingers only if the file has some.
    fingers = any(name in joints and name in body.names for name in _FINGERS)
    for name in OURS if fingers else OURS[:22]:
        k = body.at(name)[0]
        above = body.names[body.parents[k]] if body.parents[k] >= 0 else ""
        parent = whole.get(above, np.broadcast_to(np.eye(3), (len(world), 3, 3)))
        whole[name] = parent
        if name in joints:
            away[name] = _rest_rotation(name, rest, joints, body, away.get(above, trunk) if name in _FINGERS else trunk)
            whole[name] = upright @ world[:, joints[name]] @ away[name]
        pose[:, SMPLX_JOINTS.index(name)] = rotvec_from_matrix(np.swapaxes(parent, 1, 2) @ whole[name])
    params = BodyParams.from_full_pose(
        pose, betas=np.zeros(0), expression=np.zeros(0), transl=np.zeros(3), flat_hand_mean=fingers
    )
    return _placed(replace(params, fps=motion.fps), motion, joints, body, upright)


def _placed(
    params: BodyParams,
    motion: BvhMotion,
    joints: Mapping[str, int],
    body: Skeleton,
    upright: Float64[np.ndarray, "3 3"],
) -> BodyParams:
    """Return the parameters with their translation, with planted feet held as `retarget` holds them."""
    # Scale the pelvis' path, remove the sliding of planted feet, then put the lowest foot on the floor.
    places = _places(motion) @ upright.T
    scale = body.leg / _leg(motion.rest, joints)
    root = places[:, joints["pelvis"]]
    params = replace(params, transl=scale * (root - root[0]) - body.places[0] * [1.0, 0.0, 1.0])
    feet = [name for name in FEET if name in joints]
    theirs = scale * places[:, [joints[name] for name in feet]]
    own = body.pose(params)[:, body.at(*feet)]
    params = replace(params, transl=params.transl + held_feet(theirs, own, body.leg, params.fps or 1.0))
    low = body.pose(params)[:, body.at(*feet), 1].min() - body.places[body.at(*feet), 1].min()
    return replace(params, transl=params.transl - [0.0, low, 0.0])


def _leg(rest: Float64[np.ndarray, "J 3"], joints: Mapping[str, int]) -> float:
    """Return the length of the file's leg from hip to ankle, mean of both."""
    total = 0.0
    for side in ("left", "right"):
        hip, knee, ankle = (rest[joints[f"{side}_{name}"]] for name in ("hip", "knee", "ankle"))
        total += 0.5 * float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
    if not total > 0.0:
        raise InputError("legs of the motion", expected="bones of some length", received="none")
    return total


def _in_world(motion: BvhMotion) -> Float64[np.ndarray, "T J 3 3"]:
    """Return the rotations of all joints in world coordinates."""
    out = motion.rotations.copy()
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            out[:, joint] = out[:, parent] @ motion.rotations[:, joint]
    return out


def _places(motion: BvhMotion) -> Float64[np.ndarray, "T J 3"]:
    """Return the positions of all joints by forward kinematics, with the positions that the file states."""
    world = _in_world(motion)
    out = np.empty((len(motion.root), len(motion.names), 3))
    for joint, parent in enumerate(motion.parents):
        if parent < 0:
            out[:, joint] = motion.root
            continue
        # (T, 3, 3) times (T, 3, 1): a joint with position channels is elsewhere in every frame.
        step = np.atleast_2d(motion.positions.get(joint, motion.offsets[joint]))
        out[:, joint] = out[:, parent] + (world[:, parent] @ step[..., None])[..., 0]
    return out


def _upright(rest: Float64[np.ndarray, "J 3"], joints: Mapping[str, int]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation that takes the axis along which the skeleton stands at rest to +Y."""
    up = rest[joints["pelvis"]] - 0.5 * (rest[joints["left_ankle"]] + rest[joints["right_ankle"]])
    axis = int(np.argmax(np.abs(up)))
    direction = np.zeros(3)
    direction[axis] = np.sign(up[axis]) or 1.0
    return _between(direction, np.array([0.0, 1.0, 0.0]))


def _trunk(rest: Float64[np.ndarray, "J 3"], joints: Mapping[str, int], body: Skeleton) -> Float64[np.ndarray, "3 3"]:
    """Return the least-squares rotation (Kabsch) of our trunk at rest onto the file's: hips, shoulders and neck."""
    shared = [name for name in _FRAME if name in joints]
    ours, theirs = body.places[body.at(*shared)], rest[[joints[name] for name in shared]]
    ours, theirs = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    u, _, vt = np.linalg.svd(theirs.T @ ours)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _rest_rotation(
    name: str,
    rest: Float64[np.ndarray, "J 3"],
    joints: Mapping[str, int],
    body: Skeleton,
    above: Float64[np.ndarray, "3 3"],
) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a joint from our rest pose to the file's: `above`, then the smallest one for its bone."""
    side, _, part = name.rpartition("_")
    # A hand continues the direction of its forearm.
    bone = (f"{side}_elbow", name) if part == "wrist" else (name, f"{side}_{_CHILD.get(part)}")
    if any(end not in joints for end in bone):
        return above
    begin, end = body.places[body.at(*bone)]
    return _between(above @ (end - begin), rest[joints[bone[1]]] - rest[joints[bone[0]]]) @ above


def _between(a: Float64[np.ndarray, " 3"], b: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes one direction to another; the identity if one has no length."""
    lengths = np.linalg.norm(a) * np.linalg.norm(b)
    if not lengths > 0.0:
        return np.eye(3)
    axis, cosine = np.cross(a, b) / lengths, float(a @ b / lengths)
    if cosine < -1.0 + 1e-9:  # half a turn, about any axis across
        across = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        across /= np.linalg.norm(across)
        return 2.0 * np.outer(across, across) - np.eye(3)
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + K + K @ K / (1.0 + cosine)
