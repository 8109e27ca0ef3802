"""Compare a skeleton's rest pose with ours: which pose stands, where up and left are, the rotation of each joint."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.body.joint_words import FINGERS
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.retarget import Skeleton
from smplxpp.body.skeleton_match import SIDES, Tree, spine_of
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.core import matrix_from_rotvec, rotvec_from_matrix

FINGER_JOINTS = SMPLX_JOINTS[25:]
OURS = (*SMPLX_JOINTS[:22], *FINGER_JOINTS)
"""Joints that a motion can rotate: those of the body and of the fingers."""
CHILD = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
CHILD |= {f"{finger}{bone}": f"{finger}{bone + 1}" for finger in FINGERS for bone in (1, 2)}
"""The joint at the end of the bone that a joint moves, for bones whose direction tells the joint's rotation."""
_FRAME = ("left_hip", "right_hip", "left_shoulder", "right_shoulder", "neck")
_SHOULDERS = ("left_shoulder", "right_shoulder")
_STANDS = 0.5  # least cosine of a pose that stands: limbs within 60 degrees of a person who stands upright
_UPRIGHT, _NEARLY_ALL = 0.8, 0.9  # least cosine of a trunk along an axis, and least share of such frames
_TRIED = 400  # frames among which one that stands is looked for


@dataclass(frozen=True, eq=False)
class Reference:
    """A skeleton in a pose that stands, and its motion relative to it.

    Attributes:
        rest: places of the J joints: the file's rest pose, or those of a frame.
        tips: places of the ends of bones after the last joint, by its index.
        turns: rotations of the joints in the world, relative to that pose.
        places: of the joints in the world.
        frame: the frame that stands for the rest pose; None: the rest pose does.
    """

    rest: Float64[np.ndarray, "J 3"]
    tips: Mapping[int, Float64[np.ndarray, " 3"]]
    turns: Float64[np.ndarray, "T J 3 3"]
    places: Float64[np.ndarray, "T J 3"]
    frame: int | None


def reference_pose(motion: SkeletonMotion, joints: Mapping[str, int]) -> Reference:
    """Return the motion relative to its rest pose or, where that is no standing person, to the frame that stands best.

    Some programs write bones along their own axes at rest, or all at one place, and put what makes a person of them
    into the turns; others write some moment of a motion.
    """
    world = _in_world(motion)
    places, rest = _places(motion, world), motion.rest
    if motion.neutral and _stance(rest[None], joints)[0] > _STANDS:
        tips = {joint: rest[joint] + tip for joint, tip in motion.tips.items()}
        return Reference(rest, tips, world, places, None)
    tried = np.unique(np.linspace(0, len(places) - 1, min(len(places), _TRIED)).round().astype(int))
    frame = int(tried[np.argmax(_stance(places[tried], joints))])
    tips = {joint: places[frame, joint] + world[frame, joint] @ tip for joint, tip in motion.tips.items()}
    return Reference(places[frame], tips, world @ np.swapaxes(world[frame], 1, 2), places, frame)


def sides_are_exchanged(pose: Reference, joints: Mapping[str, int]) -> bool:
    """Whether feet point to where left and right are interchanged."""
    rest = pose.rest
    lateral = rest[joints["left_hip"]] - rest[joints["right_hip"]]
    up = sum(rest[joints[f"{side}_shoulder"]] - rest[joints[f"{side}_hip"]] for side in SIDES)
    front = np.cross(lateral, up)
    front = front / max(float(np.linalg.norm(front)), 1e-12)
    cosines = []
    for side in SIDES:
        ankle = joints[f"{side}_ankle"]
        end = rest[joints[f"{side}_foot"]] if f"{side}_foot" in joints else pose.tips.get(ankle)
        toes = None if end is None else end - rest[ankle]
        if toes is None or not np.linalg.norm(toes) > 0.0:
            return False
        cosines.append(float(toes @ front) / float(np.linalg.norm(toes)))
    # Least cosine of feet that point backwards, so that sides are exchanged.
    clearly = 0.5
    return max(cosines) < -clearly and bool(_stance(rest[None], joints)[0] > _STANDS)


def trunk_rotations(
    pose: Reference, joints: Mapping[str, int], body: Skeleton
) -> dict[str, Float64[np.ndarray, "3 3"]]:
    """Return for each joint the rotation from our rest pose to the file's of the part of the body that it is in."""
    if pose.frame is None:
        return dict.fromkeys(OURS, _trunk(pose.rest, joints, body))
    return _bent_trunk(pose, joints, body)


def up_axis(rest: Float64[np.ndarray, "J 3"], joints: Mapping[str, int]) -> str:
    """Return the axis along which a skeleton stands, as "y" or "-z"."""
    up = rest[joints["pelvis"]] - 0.5 * (rest[joints["left_ankle"]] + rest[joints["right_ankle"]])
    axis = int(np.argmax(np.abs(up)))
    return ("-" if up[axis] < 0.0 else "") + "xyz"[axis]


def lies_along(pose: Reference, joints: Mapping[str, int]) -> str | None:
    """Return the axis along which the trunk lies in nearly all frames, if the skeleton stands along another at rest."""
    trunk = np.zeros((len(pose.places), 3))
    for side in SIDES:
        trunk += pose.places[:, joints[f"{side}_shoulder"]] - pose.places[:, joints[f"{side}_hip"]]
    trunk /= np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-12)
    axis = int(np.argmax(np.abs(np.median(trunk, axis=0))))
    sign = float(np.sign(np.median(trunk[:, axis]))) or 1.0
    found = ("-" if sign < 0.0 else "") + "xyz"[axis]
    upright = float(np.mean(sign * trunk[:, axis] > _UPRIGHT))
    return found if upright > _NEARLY_ALL and found != up_axis(pose.rest, joints) else None


def upright_rotation(up: str) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes an axis, as `up_axis` names it, to +Y."""
    direction = np.zeros(3)
    direction["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    return _between(direction, np.array([0.0, 1.0, 0.0]))


def rest_rotation(
    name: str,
    rest: Float64[np.ndarray, "J 3"],
    joints: Mapping[str, int],
    body: Skeleton,
    above: Float64[np.ndarray, "3 3"],
) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a joint from our rest pose to the file's: `above`, then the smallest one for its bone."""
    side, _, part = name.rpartition("_")
    # A hand continues the direction of its forearm.
    bone = (f"{side}_elbow", name) if part == "wrist" else (name, f"{side}_{CHILD.get(part)}")
    if any(end not in joints for end in bone):
        return above
    begin, end = body.places[body.at(*bone)]
    return _between(above @ (end - begin), rest[joints[bone[1]]] - rest[joints[bone[0]]]) @ above


def turned_to(a: Float64[np.ndarray, "T 3"], b: Float64[np.ndarray, "T 3"]) -> Float64[np.ndarray, "T 3 3"]:
    """Return the smallest rotations that take directions `a` to `b`, frame by frame; the identity for no direction."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    known = lengths > 0.0
    scale = np.where(known, lengths, 1.0)
    axis, cosine = np.cross(a, b) / scale[:, None], np.where(known, (a * b).sum(axis=1) / scale, 1.0)
    out = np.empty((len(a), 3, 3))
    # Half a turn about any axis across, where the directions are opposite.
    opposite = cosine < -1.0 + 1e-9
    for k in np.flatnonzero(opposite):
        across = np.cross(a[k], np.eye(3)[np.argmin(np.abs(a[k]))])
        across /= np.linalg.norm(across)
        out[k] = 2.0 * np.outer(across, across) - np.eye(3)
    x, y, z = axis.T
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    rotation = np.eye(3) + K + K @ K / np.where(opposite, 1.0, 1.0 + cosine)[:, None, None]
    return np.where(opposite[:, None, None], out, rotation)


def turned_rig(
    tree: Tree,
    joints: Mapping[str, int],
    body: Skeleton,
    whole: Mapping[str, Float64[np.ndarray, "T 3 3"]],
) -> Float64[np.ndarray, "T J 4 4"]:
    """Return what moves each joint of another program's skeleton from its rest to poses of our body.

    Its bones then point where ours do, as far as both have them: a joint turns by `Q W A^-1`, with W our joint's turn,
    Q the rotation of our trunk to the file's, and A that of the joint from our rest pose to the file's
    (`rest_rotation`). Joints of the spine take the turns of ours at their height, all others follow the joint that they
    hang on. The pelvis stays where it is.

    Args:
        tree: the file's skeleton, in the pose that the turns start from; any unit.
        joints: index of its joint for each of ours (`smplxpp.body.skeleton_params.named_joints`).
        body: our skeleton at rest.
        whole: turns of our joints in the world.

    Returns:
        (T, J, 4, 4) transforms from the file's rest to each pose, in its unit.
    """
    count = len(next(iter(whole.values())))
    trunk = _trunk(tree.places, joints, body)
    away: dict[str, Float64[np.ndarray, "3 3"]] = {}
    turns: dict[int, Float64[np.ndarray, "T 3 3"]] = {}
    for name in OURS:
        if name not in joints:
            continue
        above = away.get(body.names[body.parents[body.at(name)[0]]], trunk) if name in FINGER_JOINTS else trunk
        away[name] = rest_rotation(name, tree.places, joints, body, above)
        turns[joints[name]] = trunk @ whole[name] @ away[name].T
    # How far up the trunk joints lie, from the pelvis (0) to the shoulders (1): ours turn all that is above them.
    ours = [name for name in ("spine1", "spine2", "spine3") if name in whole]
    if not any(name in joints for name in ours):
        spine = spine_of(tree, joints)
        own = _heights(body.places, body.at("pelvis", *_SHOULDERS), body.at(*ours))
        theirs = _heights(tree.places, [joints[name] for name in ("pelvis", *_SHOULDERS)], spine)
        near = 0.1  # of the trunk: joints that much below one of ours still stand for it
        for joint, height in zip(spine, theirs, strict=True):
            under = [name for name, low in zip(ours, own, strict=True) if low <= height + near]
            if under:
                turns[joint] = trunk @ whole[under[-1]] @ trunk.T
    # Parents before children.
    out = np.tile(np.eye(4), (count, len(tree.names), 1, 1))
    for joint, parent in enumerate(tree.parents):
        still = out[:, parent, :3, :3] if parent >= 0 else np.tile(np.eye(3), (count, 1, 1))
        turn = turns.get(joint, still)
        place = tree.places[joint]
        moved = place if parent < 0 else out[:, parent, :3, :3] @ place + out[:, parent, :3, 3]
        out[:, joint, :3, :3], out[:, joint, :3, 3] = turn, moved - turn @ place
    return out


def _heights(
    places: Float64[np.ndarray, "J 3"], ends: Sequence[int], joints: Sequence[int]
) -> Float64[np.ndarray, " K"]:
    """Return how far up the trunk joints lie, from the pelvis (0) to the middle between the shoulders (1).

    Args:
        places: of all joints.
        ends: indices of the pelvis and of both shoulders.
        joints: indices of those asked for.
    """
    base = places[ends[0]]
    up = places[list(ends[1:])].mean(axis=0) - base
    return (places[list(joints)] - base) @ up / max(float(up @ up), 1e-12)


def _between(a: Float64[np.ndarray, " 3"], b: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes one direction to another."""
    return turned_to(a[None], b[None])[0]


def _in_world(motion: SkeletonMotion) -> Float64[np.ndarray, "T J 3 3"]:
    """Return the rotations of all joints in world coordinates."""
    out = motion.rotations.copy()
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            out[:, joint] = out[:, parent] @ motion.rotations[:, joint]
    return out


def _places(motion: SkeletonMotion, world: Float64[np.ndarray, "T J 3 3"]) -> Float64[np.ndarray, "T J 3"]:
    """Return the positions of all joints by forward kinematics, with the positions that the file states."""
    out = np.empty((len(motion.root), len(motion.names), 3))
    for joint, parent in enumerate(motion.parents):
        if parent < 0:
            out[:, joint] = motion.root
            continue
        # (T, 3, 3) times (T, 3, 1): a joint with position channels is elsewhere in every frame.
        step = np.atleast_2d(motion.positions.get(joint, motion.offsets[joint]))
        out[:, joint] = out[:, parent] + (world[:, parent] @ step[..., None])[..., 0]
    return out


def _stance(places: Float64[np.ndarray, "T J 3"], joints: Mapping[str, int]) -> Float64[np.ndarray, " T"]:
    """Return how much each pose is a standing one: the lowest cosine of four that are 1 in a person who stands.

    Both thighs and shins point against the trunk, and hips and shoulders lie along one line.
    """

    def at(name: str) -> Float64[np.ndarray, "T 3"]:
        return places[:, joints[name]]

    def unit(step: Float64[np.ndarray, "T 3"]) -> Float64[np.ndarray, "T 3"]:
        return step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)

    hips, shoulders = (unit(at(f"left_{name}") - at(f"right_{name}")) for name in ("hip", "shoulder"))
    trunk = unit(sum(at(f"{side}_shoulder") - at(f"{side}_hip") for side in SIDES))
    cosines = [np.abs((hips * shoulders).sum(axis=1))]
    for side in SIDES:
        for upper, lower in (("hip", "knee"), ("knee", "ankle")):
            cosines.append((unit(at(f"{side}_{upper}") - at(f"{side}_{lower}")) * trunk).sum(axis=1))
    return np.min(cosines, axis=0)


def _trunk(rest: Float64[np.ndarray, "J 3"], joints: Mapping[str, int], body: Skeleton) -> Float64[np.ndarray, "3 3"]:
    """Return the least-squares rotation (Kabsch) of our trunk at rest onto the file's: hips, shoulders and neck."""
    shared = [name for name in _FRAME if name in joints]
    ours, theirs = body.places[body.at(*shared)], rest[[joints[name] for name in shared]]
    ours, theirs = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    u, _, vt = np.linalg.svd(theirs.T @ ours)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _bent_trunk(pose: Reference, joints: Mapping[str, int], body: Skeleton) -> dict[str, Float64[np.ndarray, "3 3"]]:
    """Return the rotation from our rest pose for each joint of a frame in which the trunk may be twisted.

    Hips and shoulders tell those of both ends of the trunk; its joints between take their shares of the twist. Feet
    turn to where the file's point, and dip as much from where they dip with the whole sole on the floor, because ankles
    lie at other heights over it: this is when the ankle is lowest.
    """
    rest, frame = pose.rest, pose.frame
    assert frame is not None, "a frame"

    def axes(at: Callable[[str], Float64[np.ndarray, " 3"]], part: str) -> Float64[np.ndarray, "3 3"]:
        """Return the directions to the left, up along the trunk, and to the front, as columns."""
        up = sum(at(f"{side}_shoulder") - at(f"{side}_hip") for side in SIDES)
        left = at(f"left_{part}") - at(f"right_{part}")
        left = left / max(float(np.linalg.norm(left)), 1e-12)
        up = up - left * float(left @ up)
        up = up / max(float(np.linalg.norm(up)), 1e-12)
        return np.stack([left, up, np.cross(left, up)], axis=1)

    low, high = (
        axes(lambda name: rest[joints[name]], part) @ axes(lambda name: body.places[body.at(name)[0]], part).T
        for part in ("hip", "shoulder")
    )
    twist = rotvec_from_matrix(low.T @ high)
    shares = {"pelvis": 0.0, "spine1": 1.0 / 3.0, "spine2": 2.0 / 3.0}
    out = {}
    for name in OURS:
        leg = name.partition("_")[2] in ("hip", "knee", "ankle", "foot")
        out[name] = low @ matrix_from_rotvec((0.0 if leg else shares.get(name, 1.0)) * twist)
    up = upright_rotation(up_axis(rest, joints))[1]
    for side in SIDES:
        if f"{side}_foot" in joints:
            begin, end = body.places[body.at(f"{side}_ankle", f"{side}_foot")]
            ankle, toes = (pose.places[:, joints[f"{side}_{name}"]] for name in ("ankle", "foot"))
            dip = _elevation(toes - ankle, up)
            flat = dip[int(np.argmin(ankle @ up))]
            ours = low @ (end - begin)
            level = toes[frame] - ankle[frame]
            level = level - up * float(up @ level)
            level = level / max(float(np.linalg.norm(level)), 1e-12)
            aim = float(_elevation(ours[None], up)[0] + dip[frame] - flat)
            foot = _between(ours, np.cos(aim) * level + np.sin(aim) * up) @ low
            out |= {f"{side}_ankle": foot, f"{side}_foot": foot}
    return out


def _elevation(bones: Float64[np.ndarray, "T 3"], up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " T"]:
    """Return how far bones point up, in radians."""
    return np.arcsin(np.clip((bones @ up) / np.maximum(np.linalg.norm(bones, axis=1), 1e-12), -1.0, 1.0))
