"""Convert the motion of a skeleton to parameters of a body: match joints and account for its own rest pose."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.body.bvh import read_bvh
from smplxpp.body.fbx_motion import read_fbx_motion
from smplxpp.body.gltf_motion import read_gltf_motion
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.rest_pose import (
    CHILD,
    FINGER_JOINTS,
    OURS,
    lies_along,
    reference_pose,
    rest_rotation,
    sides_are_exchanged,
    trunk_rotations,
    turned_to,
    up_axis,
    upright_rotation,
)
from smplxpp.body.retarget import FEET, Skeleton, held_feet
from smplxpp.body.skeleton_match import SIDES, Tree, match_joints, spine_of
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.core import BodyParams, GeometryWarning, InputError, rotvec_from_matrix
from smplxpp.core.errors import warn_of_left_out
from smplxpp.core.files.json_file import as_object, as_text, read_json

SKELETON_SUFFIXES = (".bvh", ".glb", ".gltf", ".vrm", ".vrma", ".fbx")
"""Endings of files whose motion is one of a skeleton of their own."""
_LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow")
NEEDED = ("pelvis", *(f"{side}_{name}" for side in ("left", "right") for name in _LIMBS))
# The joint of ours up to which a joint moves the file's bones.
_NEXT = {**CHILD, "collar": "shoulder", "ankle": "foot", "neck": "head"}
_TURNS = np.radians(2.0)  # a joint that turns less in its parent's frame, over all frames, is still


@dataclass(frozen=True)
class MatchedSkeleton:
    """What of a file's skeleton was understood.

    Attributes:
        joints: index of the file's joint for each of ours.
        taken: names of the file's joints whose turns each of ours takes over; "spine" where its joints are shared out.
        left_out: joints of the file that turn and that the body has not.
        up: axis that points up, as "y" or "-z".
        frame: the frame that stands for the rest pose; None: the rest pose does.
        leg: length of a leg in the file's unit.
    """

    joints: dict[str, int]
    taken: dict[str, tuple[str, ...]]
    left_out: tuple[str, ...]
    up: str
    frame: int | None
    leg: float

    def as_dict(self) -> dict[str, Any]:
        """Return what was understood as JSON values."""
        return {
            "joints": {ours: list(theirs) for ours, theirs in self.taken.items()},
            "missing": [name for name in OURS[:22] if name not in self.taken and not name.startswith("spine")],
            "left_out": list(self.left_out),
            "up": self.up,
            "rest": "rest pose" if self.frame is None else f"frame {self.frame}",
            "leg": self.leg,
        }


def read_skeleton(path: str | Path, *, clip: str | None = None) -> SkeletonMotion:
    """Read the motion of a skeleton from a file of any kind in `SKELETON_SUFFIXES`.

    Args:
        path: of the file.
        clip: name of the motion, in a file with several; None: the first.

    Raises:
        InputError: another kind of file, or what `read_bvh`, `read_gltf_motion` and `read_fbx_motion` refuse.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SKELETON_SUFFIXES:
        raise InputError(f"motion {path}", expected=f"one of {', '.join(SKELETON_SUFFIXES)}", received=repr(suffix))
    if suffix == ".fbx":
        return read_fbx_motion(path, clip=clip)
    if suffix != ".bvh":
        return read_gltf_motion(path, clip=clip)
    motion = read_bvh(path)
    if clip is not None:
        raise InputError(f"motion {path}: option clip", expected="a file with names of motions", received=repr(clip))
    return motion


def load_skeleton(
    path: str | Path,
    body: Skeleton,
    *,
    joint_map: Mapping[str, str] | None = None,
    up: str | None = None,
    fps: float | None = None,
    clip: str | None = None,
) -> BodyParams:
    """Read a skeleton's motion for a body: limbs point where the file's do, and steps are scaled by the legs' length.

    Args:
        path: of a file that `read_skeleton` reads.
        body: skeleton that shall move.
        joint_map: our name for each of the file's names; None: joints are found in the hierarchy.
        up: axis that points up, as "y" or "-z"; None: that along which the skeleton stands.
        fps: frames a second; None: as the file says.
        clip: name of the motion, in a file with several.

    Raises:
        InputError: what `read_skeleton` refuses, or required joints that are missing.

    Warns:
        GeometryWarning: bones below the pelvis that change their length; joints that turn and that the body has not; a
            skeleton whose frames stand along another axis than its rest pose.
    """
    motion = read_skeleton(path, clip=clip)
    motion = motion if fps is None else replace(motion, fps=fps)
    joints = named_joints(motion, joint_map, subject=f"motion {path}")
    found = matched_skeleton(motion, joints, up=up)
    warn_of_stretching(motion, joints, str(path))
    warn_of_left_out(str(path), found.left_out, reason="joints that turn and that the body has not are left out")
    if up is None and (other := lies_along(reference_pose(motion, joints), joints)):
        warnings.warn(
            f"{path}: the skeleton stands along {found.up} at rest, and along {other} in its frames: if that is no "
            f"person who lies, say up {other} (--up)",
            GeometryWarning,
            stacklevel=2,
        )
    return skeleton_params(motion, joints, body, up=up)


def matched_skeleton(motion: SkeletonMotion, joints: Mapping[str, int], *, up: str | None = None) -> MatchedSkeleton:
    """Return which of a file's joints each of ours takes over, and what else was understood of its skeleton.

    Args:
        motion: the file's skeleton and motion.
        joints: as `named_joints` returns them.
        up: axis that points up; None: that along which the skeleton stands.
    """
    reference = reference_pose(motion, joints)
    tree = Tree(motion.names, motion.parents, reference.rest)
    taken = {name: tuple(motion.names[k] for k in _path(tree, joints, name)) for name in OURS if name in joints}
    if not any(f"spine{k}" in joints for k in (1, 2, 3)):
        spine = tuple(motion.names[k] for k in spine_of(tree, joints))
        taken = {"pelvis": taken.pop("pelvis"), "spine": spine, **taken}
    # Turns of joints above those that are matched are composed into them; of all others those that move are left out.
    carried = {above for joint in joints.values() for above in tree.above(joint)}
    moved = Rotation.from_matrix(
        (np.swapaxes(motion.rotations[:1], 2, 3) @ motion.rotations).reshape(-1, 3, 3)
    ).magnitude()
    turning = moved.reshape(len(motion.root), -1).max(axis=0) > _TURNS
    left_out = tuple(name for k, name in enumerate(motion.names) if turning[k] and k not in carried)
    return MatchedSkeleton(
        joints=dict(joints),
        taken=taken,
        left_out=left_out,
        up=up or up_axis(reference.rest, joints),
        frame=reference.frame,
        leg=_leg(reference.rest, joints),
    )


def warn_of_stretching(motion: SkeletonMotion, joints: Mapping[str, int], source: str) -> None:
    """Warn of bones below the pelvis that change their length, which a body's cannot."""
    above, joint = set(), joints["pelvis"]
    while joint >= 0:
        above.add(joint)
        joint = int(motion.parents[joint])
    changed = {}
    # Largest change of a bone's length, as a share: the rounding of files is below.
    stretch = 0.02
    for joint, place in motion.positions.items():
        length = float(np.linalg.norm(motion.offsets[joint]))
        most = float(np.linalg.norm(place - motion.offsets[joint], axis=1).max())
        if joint not in above and most > stretch * length:
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
    motion: SkeletonMotion, joint_map: Mapping[str, str] | None = None, *, subject: str = "motion"
) -> dict[str, int]:
    """Return the index of the file's joint for each of our joints that it has.

    Args:
        motion: the file's skeleton and motion.
        joint_map: our name for each of the file's names, which decides alone. None: our own names, which our writer
            uses, else those that the file states, else joints found in the hierarchy (`smplxpp.body.skeleton_match`).
        subject: the file, for messages.

    Raises:
        InputError: a required joint is missing.

    Warns:
        GeometryWarning: sides that the feet contradict, which are exchanged.
    """
    names = motion.names
    if joint_map is not None:
        unknown = [name for name in joint_map if name not in names]
        if unknown:
            raise InputError(
                f"{subject}: joint map", expected=f"names of {', '.join(names)}"[:600], received=unknown[0]
            )
        found = {ours: names.index(theirs) for theirs, ours in joint_map.items()}
    elif all(name in names for name in NEEDED):
        found = {name: names.index(name) for name in OURS if name in names}
    elif all(name in motion.stated for name in NEEDED):
        found = dict(motion.stated)
    else:
        found = match_joints(names, motion.parents, motion.rest)
        if all(name in found for name in NEEDED):
            # Where the rest pose is no person, what lies left and right is looked for in a frame that stands.
            pose = reference_pose(motion, found)
            found = found if pose.frame is None else match_joints(names, motion.parents, pose.rest)
    missing = [name for name in NEEDED if name not in found]
    if missing:
        raise InputError(
            f"{subject}: joints",
            expected=f"joints that stand for {', '.join(NEEDED)}",
            received=f"none for {', '.join(missing)}, among {', '.join(names)}"[:600],
            remedy='name them with --joint-map FILE, JSON as {"LeftUpLeg": "left_hip", ...}',
        )
    if joint_map is None and sides_are_exchanged(reference_pose(motion, found), found):
        warnings.warn(
            f"{subject}: what is named left lies on the right of where the feet point: taken by place",
            GeometryWarning,
            stacklevel=3,
        )
        other = {"left": "right", "right": "left"}
        found = {"_".join(other.get(word, word) for word in name.split("_")): k for name, k in found.items()}
    return found


def skeleton_params(
    motion: SkeletonMotion, joints: Mapping[str, int], body: Skeleton, *, up: str | None = None
) -> BodyParams:
    """Return the parameters of a body that moves as the skeleton does.

    A joint's rotation in world coordinates is the file's, times the rotation from our rest pose to the file's. For
    hips, knees, shoulders, elbows and fingers this is the smallest rotation between the directions of their bones; for
    all others it is the rotation between the trunks. So arms that hang in the file's rest pose hang here too. Turns of
    joints that we have not (twists, more bones of spine and neck) are composed into those that we have: a bone of ours
    takes the mean of the turns along the file's bones that it stands for, weighted by their lengths, and limbs then
    point where the file's do. Fingers that the file lacks follow their hands or, if it has none at all, stay at rest.
    Translations are scaled by the ratio of the legs' lengths, which also converts units. The lowest foot is put at the
    height of the feet at rest, and the first frame above the origin.
    """
    # Turns of the file in the world, and the rotations between both rest poses.
    reference = reference_pose(motion, joints)
    rest, places = reference.rest, reference.places
    trunks = trunk_rotations(reference, joints, body)
    upright = upright_rotation(up or up_axis(rest, joints))
    turns = _turns(reference.turns, Tree(motion.names, motion.parents, rest), joints, body)
    pose = np.zeros((len(places), len(SMPLX_JOINTS), 3))
    away: dict[str, Float64[np.ndarray, "3 3"]] = {}
    whole: dict[str, Float64[np.ndarray, "T 3 3"]] = {}
    # Parents before children; without a face, and fingers only if the file has some.
    fingers = any(name in joints and name in body.names for name in FINGER_JOINTS)
    for name in OURS if fingers else OURS[:22]:
        k = body.at(name)[0]
        above = body.names[body.parents[k]] if body.parents[k] >= 0 else ""
        parent = whole.get(above, np.broadcast_to(np.eye(3), (len(places), 3, 3)))
        whole[name] = parent
        if name in turns:
            away[name] = rest_rotation(
                name, rest, joints, body, away.get(above, trunks[name]) if name in FINGER_JOINTS else trunks[name]
            )
            whole[name] = upright @ turns[name] @ away[name]
            # Bones between that bend, or that stretch, must not change where the limb points.
            side, _, part = name.rpartition("_")
            end = f"{side}_{CHILD.get(part)}"
            if part in _LIMBS and end in joints:
                own = body.places[body.at(end)[0]] - body.places[k]
                theirs = (places[:, joints[end]] - places[:, joints[name]]) @ upright.T
                whole[name] = turned_to(whole[name] @ own, theirs) @ whole[name]
        pose[:, SMPLX_JOINTS.index(name)] = rotvec_from_matrix(np.swapaxes(parent, 1, 2) @ whole[name])
    params = BodyParams.from_full_pose(
        pose, betas=np.zeros(0), expression=np.zeros(0), transl=np.zeros(3), flat_hand_mean=fingers
    )
    params = replace(params, fps=motion.fps)
    return _placed(params, places @ upright.T, body.leg / _leg(rest, joints), joints, body)


def _turns(
    world: Float64[np.ndarray, "T J 3 3"],
    tree: Tree,
    joints: Mapping[str, int],
    body: Skeleton,
) -> dict[str, Float64[np.ndarray, "T 3 3"]]:
    """Return the turn of the file, in the world, that each of our joints takes over."""
    turns = {}
    for name, joint in joints.items():
        path = _path(tree, joints, name)
        if len(path) < 2:
            turns[name] = world[:, joint]
            continue
        ends = [*path[1:], joints[_next(name)]]
        turns[name] = _mean_turn(world, path, [tree.length([a, b]) for a, b in zip(path, ends, strict=True)])
    if not any(f"spine{k}" in joints for k in (1, 2, 3)):
        turns |= _spine_turns(world, tree, joints, body)
    # Without a collar the shoulder hangs on a joint whose turn the collar's is.
    for side in SIDES:
        if f"{side}_collar" not in joints:
            turns[f"{side}_collar"] = world[:, tree.parents[joints[f"{side}_shoulder"]]]
    return turns


def _path(tree: Tree, joints: Mapping[str, int], name: str) -> list[int]:
    """Return the file's joints from one of ours to the one before the next of ours."""
    end = joints.get(_next(name))
    return [joints[name], *tree.below(joints[name], end)[:-1]] if end is not None else [joints[name]]


def _next(name: str) -> str:
    """Return the joint of ours up to which a joint moves bones; empty without one."""
    side, _, part = name.rpartition("_")
    end = _NEXT.get(part, "")
    return f"{side}_{end}" if side and end else end


def _spine_turns(
    world: Float64[np.ndarray, "T J 3 3"], tree: Tree, joints: Mapping[str, int], body: Skeleton
) -> dict[str, Float64[np.ndarray, "T 3 3"]]:
    """Return the turns of our three joints of the spine from a spine of any number of joints.

    Along the trunk, from the pelvis (0) to the neck (1), the file's turn is constant from each of its joints to the
    next. Each of ours takes the mean over the part of the trunk that it moves.
    """
    spine = [joints["pelvis"], *spine_of(tree, joints)]
    ours = ["pelvis", "spine1", "spine2", "spine3"]
    # Where the trunk ends: at the neck or, without one, between the shoulders.
    ends = ["neck"] if "neck" in joints else ["left_shoulder", "right_shoulder"]
    theirs = np.vstack([tree.places[spine], tree.places[[joints[name] for name in ends]].mean(axis=0)])
    own = np.vstack([body.places[body.at(*ours)], body.places[body.at(*ends)].mean(axis=0)])
    shares = [_shares(places) for places in (theirs, own)]
    turns = {}
    for k, name in enumerate(ours[1:], start=1):
        low, high = np.maximum(shares[0][:-1], shares[1][k]), np.minimum(shares[0][1:], shares[1][k + 1])
        turns[name] = _mean_turn(world, spine, np.maximum(high - low, 0.0))
    return turns


def _shares(places: Float64[np.ndarray, "K 3"]) -> Float64[np.ndarray, " K"]:
    """Return how far along a line of points each of them is, from 0 to 1."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    return along / along[-1] if along[-1] > 0.0 else np.linspace(0.0, 1.0, len(along))


def _mean_turn(
    world: Float64[np.ndarray, "T J 3 3"], joints: Sequence[int], weights: Sequence[float] | Float64[np.ndarray, " K"]
) -> Float64[np.ndarray, "T 3 3"]:
    """Return the rotation nearest to the weighted sum of joints' rotations (the chordal mean), of each frame."""
    weight = np.asarray(weights, np.float64)
    # Weights by rounding alone must not blur turns that are one joint's.
    heavy = [k for k in range(len(weight)) if weight[k] > 1e-4 * weight.sum()]
    if len(heavy) < 2:
        return world[:, joints[heavy[0] if heavy else 0]]
    total = np.einsum("k,tkab->tab", weight[heavy], world[:, [joints[k] for k in heavy]])
    u, _, vt = np.linalg.svd(total)
    u[..., 2] *= np.linalg.det(u @ vt)[:, None]
    return np.asarray(u @ vt)


def _placed(
    params: BodyParams,
    places: Float64[np.ndarray, "T J 3"],
    scale: float,
    joints: Mapping[str, int],
    body: Skeleton,
) -> BodyParams:
    """Return the parameters with their translation, with planted feet held as `retarget` holds them."""
    # Scale the pelvis' path, remove the sliding of planted feet, then put the lowest foot on the floor.
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
