"""Skeletons of other programs: joints are found by who hangs on whom, and limbs point where the file's do."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.bvh import read_bvh
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.body.skeleton_params import load_skeleton, matched_skeleton, named_joints, skeleton_params
from smplxpp.core import BodyParams, GeometryWarning, matrix_from_rotvec
from smplxpp.core.rotations import rotvec_from_matrix
from smplxpp.export.motion_files import write_bvh
from tests.body.walks import shaped, walk

SIDES = {"left": ("Left", "L", "l", "左"), "right": ("Right", "R", "r", "右")}
LIMBS = [("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")]
# Names of pelvis, spine (1 to 3), neck and head, then of a limb's joints with {0} Left, {1} L, {2} l, {3} 左:
# hip, knee, ankle, foot, collar, shoulder, elbow, wrist.
PROGRAMS = {
    "humanik": "Hips Spine Spine1 Spine2 Neck Head {0}UpLeg {0}Leg {0}Foot {0}ToeBase {0}Shoulder {0}Arm {0}ForeArm "
    "{0}Hand",
    "unreal": "pelvis spine_01 spine_02 spine_03 neck_01 head thigh_{2} calf_{2} foot_{2} ball_{2} clavicle_{2} "
    "upperarm_{2} lowerarm_{2} hand_{2}",
    "vrm": "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head J_Bip_{1}_UpperLeg "
    "J_Bip_{1}_LowerLeg J_Bip_{1}_Foot J_Bip_{1}_ToeBase J_Bip_{1}_Shoulder J_Bip_{1}_UpperArm J_Bip_{1}_LowerArm "
    "J_Bip_{1}_Hand",
    "xsens": "Hips Chest Chest2 Chest3 Neck Head {0}Hip {0}Knee {0}Ankle {0}Toe {0}Collar {0}Shoulder {0}Elbow "
    "{0}Wrist",
    "biped": "Bip01 Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head Bip01_{1}_Thigh Bip01_{1}_Calf "
    "Bip01_{1}_Foot Bip01_{1}_Toe0 Bip01_{1}_Clavicle Bip01_{1}_UpperArm Bip01_{1}_Forearm Bip01_{1}_Hand",
    "poser": "hip abdomen chest chestUpper neck head {2}Thigh {2}Shin {2}Foot {2}Toe {2}Collar {2}Shldr {2}ForeArm "
    "{2}Hand",
    "motive": "Hip Ab Chest Chest1 Neck Head {1}Thigh {1}Shin {1}Foot {1}Toe {1}Shoulder {1}UArm {1}FArm {1}Hand",
    "mmd": "下半身 上半身 上半身2 上半身3 首 頭 {3}足 {3}ひざ {3}足首 {3}つま先 {3}肩 {3}腕 {3}ひじ {3}手首",
    "opensim": "pelvis lumbar1 lumbar2 torso neck head femur_{2} tibia_{2} talus_{2} toes_{2} scapula_{2} humerus_{2} "
    "radius_{2} hand_{2}",
}
JOINTS = "pelvis spine1 spine2 spine3 neck head hip knee ankle foot collar shoulder elbow wrist".split()


@cache
def lively(frames: int = 9) -> BodyParams:
    """The walk, with a trunk, a neck and arms that bend: smooth turns of up to half a radian."""
    params, rng = walk(None).select(slice(0, 45, 5)), np.random.default_rng(2)
    pose = params.body_pose.reshape(frames, 21, 3).copy()
    phase = np.linspace(0.0, np.pi, frames)[:, None]
    for name in "spine1 spine2 spine3 neck head left_collar right_shoulder left_elbow right_wrist".split():
        pose[:, shaped(None).names.index(name) - 1] += 0.5 * np.sin(phase) * rng.uniform(-1.0, 1.0, 3)
    return replace(params, body_pose=pose.reshape(frames, 63))


@pytest.fixture(scope="module")
def motion(tmp_path_factory) -> SkeletonMotion:
    """The lively walk as our exporter writes it, without fingers and face."""
    path = tmp_path_factory.mktemp("bvh") / "lively.bvh"
    write_bvh(path, load_body(), lively())
    whole = read_bvh(path)
    kept = [k for k, name in enumerate(whole.names) if name in shaped(None).names[:22]]
    return replace(
        whole,
        names=tuple(whole.names[k] for k in kept),
        parents=np.array([kept.index(whole.parents[k]) if whole.parents[k] >= 0 else -1 for k in kept]),
        offsets=whole.offsets[kept],
        rotations=whole.rotations[:, kept],
        tips={},
    )


def called(motion: SkeletonMotion, program: str) -> SkeletonMotion:
    """The motion with the joints' names of another program."""
    table = dict(zip(JOINTS, PROGRAMS[program].split(), strict=True))

    def name(ours: str) -> str:
        side, _, part = ours.rpartition("_")
        return table[part].format(*SIDES[side]) if side else table[part]

    return replace(motion, names=tuple(map(name, motion.names)))


def inserted(
    motion: SkeletonMotion, name: str, below: str, share: float, turns: np.ndarray | None = None
) -> SkeletonMotion:
    """The motion with one more joint between `below` and its parent, at a share of the bone, with turns of its own.

    What hangs on it keeps its places and its turns in the world only if `turns` is None.
    """
    at = motion.names.index(below)
    offset = motion.offsets[at]
    offsets = np.insert(motion.offsets, at, share * offset, axis=0)
    offsets[at + 1] = (1.0 - share) * offset
    own = np.tile(np.eye(3), (len(motion.root), 1, 1)) if turns is None else turns
    return replace(
        motion,
        names=(*motion.names[:at], name, *motion.names[at:]),
        parents=np.insert(motion.parents + (motion.parents >= at), at, motion.parents[at])
        + (np.arange(len(motion.names) + 1) == at + 1) * (at - motion.parents[at]),
        offsets=offsets,
        rotations=np.insert(motion.rotations, at, own, axis=1),
    )


def rebased(motion: SkeletonMotion, turns: np.ndarray) -> SkeletonMotion:
    """The same places and motion by a skeleton whose bones' axes are others: `G' = G A`, for each joint."""
    world = np.empty_like(motion.rotations)
    offsets, rotations = motion.offsets.copy(), motion.rotations.copy()
    for joint, parent in enumerate(motion.parents):
        world[:, joint] = motion.rotations[:, joint] if parent < 0 else world[:, parent] @ motion.rotations[:, joint]
        if parent >= 0:
            offsets[joint] = turns[parent].T @ offsets[joint]
        above = np.eye(3) if parent < 0 else world[:, parent] @ turns[parent]
        rotations[:, joint] = (
            np.swapaxes(np.broadcast_to(above, world[:, joint].shape), 1, 2) @ world[:, joint] @ turns[joint]
        )
    return replace(motion, offsets=offsets, rotations=rotations)


def relative(params: BodyParams) -> np.ndarray:
    """(T, 22, 3) joints from the pelvis of their frame on, metres."""
    found = shaped(None).pose(params)[:, :22]
    return found - found[:, :1]


def limbs_of_file(motion: SkeletonMotion, names: dict[str, str]) -> np.ndarray:
    """(T, 8, 3) unit directions of arms and legs by forward kinematics, frame by frame."""
    places, world = np.zeros((len(motion.root), len(motion.names), 3)), np.empty_like(motion.rotations)
    for k, parent in enumerate(motion.parents):
        world[:, k] = motion.rotations[:, k] if parent < 0 else world[:, parent] @ motion.rotations[:, k]
        places[:, k] = motion.root if parent < 0 else places[:, parent] + world[:, parent] @ motion.offsets[k]
    at = {name: places[:, motion.names.index(names[name])] for name in names}
    return directions(at)


def directions(at: dict[str, np.ndarray]) -> np.ndarray:
    bones = np.stack([at[f"{s}_{b}"] - at[f"{s}_{a}"] for s in SIDES for a, b in LIMBS], axis=1)
    return bones / np.linalg.norm(bones, axis=2, keepdims=True)


def limbs_of_body(params: BodyParams) -> np.ndarray:
    found = shaped(None).pose(params)
    return directions({name: found[:, k] for k, name in enumerate(shaped(None).names[:22])})


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0))).max())


@pytest.mark.parametrize("program", PROGRAMS)
def test_joints_of_any_program_are_found(motion, program):
    """Names of one program alone were known: the others were refused, or joints were taken for their neighbours."""
    theirs = called(motion, program)
    found = named_joints(theirs)
    assert {ours: motion.names[k] for ours, k in found.items()} == {name: name for name in found}
    assert set(found) == {name for name in motion.names if not name.startswith("spine")}
    params = skeleton_params(theirs, found, shaped(None))
    np.testing.assert_allclose(relative(params), relative(lively()), atol=2e-5)


def test_joints_without_names_are_found_by_their_hierarchy(motion):
    strange = replace(motion, names=tuple(f"bone.{k:03d}" for k in range(len(motion.names))))
    np.testing.assert_allclose(
        relative(skeleton_params(strange, named_joints(strange), shaped(None))), relative(lively()), atol=2e-5
    )


@pytest.mark.parametrize("count", [1, 2, 4, 6])
def test_spines_of_any_length_carry_all_turns(motion, count):
    """A chest between known joints was dropped, and with it its turn: the head was 65 mm off."""
    theirs = called(motion, "vrm")
    names = iter(f"J_Bip_C_Extra{k}" for k in range(9))
    if count > 3:
        # More joints that turn with their parents are at other heights; the pose is the same.
        for below, share in (("J_Bip_C_Chest", 0.4), ("J_Bip_C_UpperChest", 0.7), ("J_Bip_C_Neck", 0.5))[: count - 3]:
            theirs = inserted(theirs, next(names), below, share)
        np.testing.assert_allclose(
            relative(skeleton_params(theirs, named_joints(theirs), shaped(None))), relative(lively()), atol=2e-5
        )
    else:
        # Fewer joints: their turns are composed into those that are left, so that what hangs on them keeps its place.
        for gone in ("J_Bip_C_Chest", "J_Bip_C_Spine")[: 3 - count]:
            theirs = without(theirs, gone)
        found = skeleton_params(theirs, named_joints(theirs), shaped(None))
        truth = limbs_of_body(lively())
        assert degrees(limbs_of_body(found), truth) < 0.01
        stiff = directions_of_trunk(theirs), directions_of_trunk(found)
        assert degrees(*stiff) < (0.1 if count == 2 else 4.0)
    assert len(matched_skeleton(theirs, named_joints(theirs)).taken["spine"]) == count


def without(motion: SkeletonMotion, name: str) -> SkeletonMotion:
    """The motion without a joint, whose turns its children take over."""
    at = motion.names.index(name)
    parents, offsets, rotations = motion.parents.copy(), motion.offsets.copy(), motion.rotations.copy()
    for child in np.flatnonzero(motion.parents == at):
        rotations[:, child] = motion.rotations[:, at] @ motion.rotations[:, child]
        offsets[child] += motion.offsets[at]
        parents[child] = motion.parents[at]
    parents = np.delete(parents - (parents > at), at)
    return replace(
        motion,
        names=(*motion.names[:at], *motion.names[at + 1 :]),
        parents=parents,
        offsets=np.delete(offsets, at, axis=0),
        rotations=np.delete(rotations, at, axis=1),
    )


def directions_of_trunk(of: SkeletonMotion | BodyParams) -> np.ndarray:
    """(T, 3) unit direction from the pelvis to the neck."""
    if isinstance(of, BodyParams):
        line = relative(of)[:, shaped(None).names.index("neck")]
    else:
        world, place, joint = np.eye(3), np.zeros(3), of.names.index("J_Bip_C_Neck")
        chain = [joint]
        while of.parents[chain[-1]] >= 0:
            chain.append(int(of.parents[chain[-1]]))
        for above, k in zip(chain[:0:-1], chain[-2::-1], strict=True):
            world = world @ of.rotations[:, above]
            place = place + world @ of.offsets[k]
        line = place
    return line / np.linalg.norm(line, axis=1, keepdims=True)


def test_bones_between_that_bend_turn_the_limb(motion):
    """Joints within a thigh and a forearm, which nobody has a name for, took the foot and the hand elsewhere."""
    theirs = called(motion, "unreal")
    bend = matrix_from_rotvec(np.linspace(0.0, 0.4, len(motion.root))[:, None] * np.array([1.0, 0.3, 0.2]))
    for name, below in (("thigh_part_l", "calf_l"), ("lowerarm_part_r", "hand_r"), ("neck_02", "head")):
        theirs = inserted(theirs, name, below, 0.5, bend)
    found = named_joints(theirs)
    truth = limbs_of_file(theirs, {ours: theirs.names[k] for ours, k in found.items()})
    assert degrees(limbs_of_body(skeleton_params(theirs, found, shaped(None))), truth) < 0.01
    taken = matched_skeleton(theirs, found).taken
    assert taken["left_hip"] == ("thigh_l", "thigh_part_l") and taken["neck"] == ("neck_01", "neck_02")


def test_rest_poses_that_are_no_person_are_understood(motion):
    """Bones along axes of their own at rest: turned trunks of up to 90 degrees came of it."""
    turns = matrix_from_rotvec(np.random.default_rng(0).normal(0.0, 2.0, (len(motion.names), 3)))
    theirs = rebased(called(motion, "humanik"), turns)
    found = named_joints(theirs)
    params = skeleton_params(theirs, found, shaped(None))
    assert matched_skeleton(theirs, found).frame is not None
    assert degrees(limbs_of_body(params), limbs_of_body(lively())) < 0.01
    np.testing.assert_allclose(relative(params), relative(lively()), atol=0.03)


def test_sides_are_told_by_place(motion):
    """Names of a mirrored file: what is called left is on the right of where the feet point."""
    other = {"left": "right", "right": "left"}
    names = ["_".join(other.get(word, word) for word in name.split("_")) for name in motion.names]
    with pytest.warns(GeometryWarning, match="named left lies on the right"):
        found = named_joints(replace(motion, names=tuple(names)))
    assert all(motion.names[k] == ours for ours, k in found.items())


def test_joints_that_turn_and_are_no_persons_are_named(tmp_path):
    """A jaw, a tail: their turns are left out, and the warning says so once."""
    pose = lively()
    write_bvh(
        tmp_path / "a.bvh", load_body(), replace(pose, jaw_pose=np.linspace(0.0, 0.3, len(pose))[:, None] * [1, 0, 0])
    )
    with pytest.warns(GeometryWarning, match="left out: jaw$"):
        load_skeleton(tmp_path / "a.bvh", shaped(None))


def test_the_stated_axis_wins_and_a_lying_file_is_told(tmp_path):
    """A skeleton that stands along y at rest and along z in its frames."""
    write_bvh(
        tmp_path / "a.bvh", load_body(), replace(walk(None), global_orient=np.tile([0.5 * np.pi, 0.0, 0.0], (46, 1)))
    )
    with pytest.warns(GeometryWarning, match="stands along y at rest, and along z in its frames"):
        lying = load_skeleton(tmp_path / "a.bvh", shaped(None))
    standing = load_skeleton(tmp_path / "a.bvh", shaped(None), up="z", fps=12.0)
    up = (
        matrix_from_rotvec(lying.global_orient)[0] @ [0, 1, 0],
        matrix_from_rotvec(standing.global_orient)[0] @ [0, 1, 0],
    )
    np.testing.assert_allclose(up, [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], atol=1e-6)
    assert standing.fps == 12.0


def test_rotations_compose_as_the_mean(motion):
    """The mean of two turns about one axis is half their sum."""
    from smplxpp.body.skeleton_params import _mean_turn

    world = matrix_from_rotvec(np.array([[[0.0, 0.0, 0.2], [0.0, 0.0, 0.8]]]))
    np.testing.assert_allclose(rotvec_from_matrix(_mean_turn(world, [0, 1], [1.0, 1.0])), [[0.0, 0.0, 0.5]], atol=1e-12)
