"""Motions of other bodies: the same body's comes back, standing feet stand, and BVH's skeletons are understood."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.bvh import read_bvh
from smplxpp.body.retarget import Skeleton, retarget
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.body.skeleton_params import load_skeleton, named_joints, read_joint_map, skeleton_params
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec
from smplxpp.export.motion_files import write_bvh
from tests.body.walks import FPS, betas, rotation_z, shaped, slide, walk

PAIRS = [(1, 2), (1, None), (5, 6), (None, 9)]


def scaled_alone(params: BodyParams, source: Skeleton, target: Skeleton) -> BodyParams:
    """The root's way in proportion to the legs, and nothing else."""
    pelvis = source.pose(params)[:, 0]
    start = pelvis[0] * [1.0, 0.0, 1.0]
    return replace(params, transl=start + target.leg / source.leg * (pelvis - start) - target.places[0])


# --- bodies of one family --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, None])
def test_the_same_body_moves_as_it_did(seed):
    body = shaped(seed)
    again = retarget(walk(seed), body, body)
    for name, value in walk(seed).as_dict().items():
        np.testing.assert_allclose(again.as_dict()[name], value, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_feet_that_stood_stand(source, target):
    mine, theirs = shaped(source), shaped(target)
    assert slide(mine, walk(source)) < 0.01  # the walk itself
    plain = slide(theirs, walk(source))
    scaled = slide(theirs, scaled_alone(walk(source), mine, theirs))
    held = slide(theirs, retarget(walk(source), mine, theirs))
    assert plain > 15.0 and scaled < 0.5 * plain and held < 1.5 and held < 0.2 * scaled


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_there_and_back(source, target):
    mine, theirs = shaped(source), shaped(target)
    there = retarget(walk(source), mine, theirs)
    back = retarget(there, theirs, mine)
    np.testing.assert_array_equal(back.body_pose, walk(source).body_pose)
    assert np.abs(back.transl - walk(source).transl).max() < 6e-3
    walked, first = (float(np.ptp(one.transl[:, 2])) for one in (there, walk(source)))
    assert walked / first == pytest.approx(theirs.leg / mine.leg, rel=0.05)


def test_the_floor_stays():
    mine, theirs = shaped(1), shaped(2)
    feet = mine.at("left_foot", "right_foot", "left_ankle", "right_ankle")
    low = [one[:, feet, 1].min() for one in (mine.pose(walk(1)), theirs.pose(retarget(walk(1), mine, theirs)))]
    assert low[0] == pytest.approx(low[1], abs=1e-9)


def test_a_turned_and_moved_motion_is_retargeted_alike():
    """A turn about the vertical and a shift on the floor commute with it."""
    mine, theirs, turn = shaped(1), shaped(2), matrix_from_rotvec(np.array([0.0, 0.8, 0.0]))

    def moved(params: BodyParams, body: Skeleton) -> BodyParams:
        orient = np.array([rotvec(turn @ matrix_from_rotvec(one)) for one in params.global_orient])
        pelvis = (params.transl + body.places[0]) @ turn.T + [3.0, 0.0, -1.0]
        return replace(params, global_orient=orient, transl=pelvis - body.places[0])

    from smplxpp.core.rotations import rotvec_from_matrix as rotvec

    one = retarget(moved(walk(1), mine), mine, theirs)
    other = moved(retarget(walk(1), mine, theirs), theirs)
    way = [np.diff(params.transl, axis=0) for params in (one, other)]
    np.testing.assert_allclose(way[0], way[1], atol=1e-9)


def test_a_skeleton_without_legs_is_refused():
    body = shaped(None)
    legless = replace(body, names=tuple(name.replace("knee", "wheel") for name in body.names))
    with pytest.raises(InputError, match="left_knee"):
        retarget(walk(None), body, legless)


# --- BVH -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """The walk as our own exporter writes it."""
    path = tmp_path_factory.mktemp("bvh") / "walk.bvh"
    write_bvh(path, load_body(), walk(None))
    return path


def same_motion(params: BodyParams, truth: BodyParams, *, degrees: float = 0.01) -> None:
    """Joints of the body in the world are turned alike."""
    ours, theirs = (
        matrix_from_rotvec(np.concatenate([one.global_orient, one.body_pose], 1).reshape(len(one), -1, 3))
        for one in (params, truth)
    )
    cosine = 0.5 * (np.einsum("tjab,tjab->tj", ours, theirs) - 1.0)
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < degrees


def test_our_own_file_comes_back(file):
    params = load_skeleton(file, shaped(None))
    same_motion(params, walk(None))
    assert params.fps == pytest.approx(FPS, rel=1e-5)
    np.testing.assert_allclose(np.diff(params.transl, axis=0), np.diff(walk(None).transl, axis=0), atol=1e-5)


def waving() -> BodyParams:
    """The walk with fingers that bend and spread."""
    rng, motion = np.random.default_rng(5), walk(None)
    left, right = rng.normal(0.0, 0.3, (2, len(motion), 45))
    return replace(motion, left_hand_pose=left, right_hand_pose=right, flat_hand_mean=True)


def complete_hands(params: BodyParams) -> np.ndarray:
    """(T, 30, 3, 3) turns of the fingers' joints."""
    return load_body().joint_rotations(replace(params, betas=np.zeros((len(params), 0))))[:, 25:]


@pytest.mark.parametrize(
    "change",
    [
        lambda motion: motion,
        lambda motion: fingers_named(motion, "mixamorig:{side}Hand{finger}{bone}"),
        lambda motion: fingers_named(motion, "{finger}_0{bone}_{s}"),
        lambda motion: fingers_named(motion, "{s}{finger}{bone}"),
    ],
)
def test_fingers_come_back_by_anyones_names(tmp_path, change):
    write_bvh(tmp_path / "a.bvh", load_body(), waving())
    motion = change(read_bvh(tmp_path / "a.bvh"))
    params = skeleton_params(motion, named_joints(motion), shaped(None))
    np.testing.assert_allclose(complete_hands(params), complete_hands(waving()), atol=2e-4)
    same_motion(params, walk(None))


def fingers_named(motion: SkeletonMotion, way: str) -> SkeletonMotion:
    def other(name: str) -> str:
        side, _, part = name.rpartition("_")
        if part[:-1] not in ("index", "middle", "pinky", "ring", "thumb"):
            return MIXAMO.get(name, name)
        return way.format(side=side.capitalize(), s=side[0], finger=part[:-1].capitalize(), bone=part[-1])

    return replace(motion, names=tuple(map(other, motion.names)))


def test_fingers_that_are_bent_at_rest_point_where_the_files_do(tmp_path):
    """A skeleton whose first finger bones point down at rest: the same pose, told by other turns."""
    write_bvh(tmp_path / "a.bvh", load_body(), waving())
    motion = read_bvh(tmp_path / "a.bvh")
    names, turn = list(motion.names), rotation_z(-0.6)
    bent = [k for k, name in enumerate(names) if name.startswith("left_index")]
    offsets, rotations = motion.offsets.copy(), motion.rotations.copy()
    # G' = G A along the finger: its own turns follow, bones at rest are A times what they were.
    for k in bent:
        parent = motion.parents[k]
        rotations[:, k] = (turn.T if parent in bent else np.eye(3)) @ rotations[:, k] @ turn
        if parent in bent:
            offsets[k] = turn.T @ offsets[k]
    other = replace(motion, offsets=offsets, rotations=rotations)
    params = skeleton_params(other, named_joints(other), shaped(None))
    body, truth, found = load_body(), waving(), replace(params, transl=waving().transl)
    joints = [body.joint_names.index(f"left_index{bone}") for bone in (1, 2, 3)]
    where = [body.forward(replace(one, betas=np.zeros((len(one), 10)))).joints[:, joints] for one in (truth, found)]
    np.testing.assert_allclose(np.diff(where[1], axis=1), np.diff(where[0], axis=1), atol=1e-5)


def test_hands_of_a_file_without_fingers_stay_as_they_are(file):
    motion = read_bvh(file)
    names = named_joints(motion)
    bare = {name: joint for name, joint in names.items() if name in shaped(None).names[:22]}
    params = skeleton_params(motion, bare, shaped(None))
    assert not params.flat_hand_mean and not params.left_hand_pose.any()


def test_a_walk_of_another_skeleton_does_not_slide(file):
    target = shaped(2)
    assert slide(target, load_skeleton(file, target)) < 1.5


MIXAMO = dict(
    pelvis="Hips",
    spine1="Spine",
    spine2="Spine1",
    spine3="Spine2",
    neck="Neck",
    head="Head",
    **{
        f"{side}_{ours}": f"{side.capitalize()}{theirs}"
        for side in ("left", "right")
        for ours, theirs in {
            "hip": "UpLeg",
            "knee": "Leg",
            "ankle": "Foot",
            "foot": "ToeBase",
            "collar": "Shoulder",
            "shoulder": "Arm",
            "elbow": "ForeArm",
            "wrist": "Hand",
        }.items()
    },
)


def renamed(motion: SkeletonMotion, prefix: str = "mixamorig:") -> SkeletonMotion:
    return replace(motion, names=tuple(prefix + MIXAMO.get(name, name) for name in motion.names))


def arms_down(motion: SkeletonMotion) -> SkeletonMotion:
    """The same motion of a skeleton whose arms hang at rest: `G' = G A` with A the turn from hanging to level."""
    names, parents = list(motion.names), motion.parents
    world = np.empty_like(motion.rotations)
    level = np.tile(np.eye(3), (len(names), 1, 1))
    for joint, parent in enumerate(parents):
        world[:, joint] = motion.rotations[:, joint] if parent < 0 else world[:, parent] @ motion.rotations[:, joint]
        for side, angle in (("left", 1.2), ("right", -1.2)):
            if names[joint] == f"{side}_shoulder" or (
                parent >= 0 and _below(names, parents, joint, f"{side}_shoulder")
            ):
                level[joint] = rotation_z(angle)
    world = world @ level
    offsets, rotations = motion.offsets.copy(), motion.rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            offsets[joint] = level[parent].T @ offsets[joint]
            rotations[:, joint] = np.swapaxes(world[:, parent], 1, 2) @ world[:, joint]
    return replace(motion, offsets=offsets, rotations=rotations)


def _below(names: list[str], parents: np.ndarray, joint: int, above: str) -> bool:
    while joint >= 0:
        if names[joint] == above:
            return True
        joint = parents[joint]
    return False


def z_up(motion: SkeletonMotion) -> SkeletonMotion:
    """The same in a world whose third axis points up."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    rotations = np.einsum("ab,tjbc,dc->tjad", turn, motion.rotations, turn)
    return replace(motion, offsets=motion.offsets @ turn.T, rotations=rotations, root=motion.root @ turn.T)


@pytest.mark.parametrize("change", [renamed, arms_down, z_up, lambda m: renamed(arms_down(z_up(m)))])
def test_other_names_rests_and_axes(file, change):
    motion, body = change(read_bvh(file)), shaped(None)
    params = skeleton_params(motion, named_joints(motion), body)
    if change is z_up or change is renamed:
        same_motion(params, walk(None))
    else:  # an arm's twist about itself is not told by the direction of its bones
        truth = shaped(None).pose(walk(None))[:, :22]
        found = shaped(None).pose(replace(params, transl=params.transl - params.transl[0] + walk(None).transl[0]))
        np.testing.assert_allclose(found[:, :22], truth, atol=6e-3)
    np.testing.assert_allclose(np.diff(params.transl, axis=0), np.diff(walk(None).transl, axis=0), atol=1e-4)


def test_unknown_joints_are_named_and_a_map_helps(file, tmp_path):
    motion = read_bvh(file)
    strange = replace(motion, names=tuple(f"bone{k}" for k in range(len(motion.names))))
    legs = [k for k, name in enumerate(motion.names) if name in shaped(None).names[:9]]
    half = replace(
        strange,
        names=tuple(strange.names[k] for k in legs),
        parents=np.array([legs.index(motion.parents[k]) if motion.parents[k] >= 0 else -1 for k in legs]),
        offsets=motion.offsets[legs],
        rotations=motion.rotations[:, legs],
    )
    with pytest.raises(InputError, match=r"none for pelvis.*among bone0.*--joint-map"):
        named_joints(half)
    table = {f"bone{k}": name for k, name in enumerate(motion.names) if name in shaped(None).names[:22]}
    (tmp_path / "map.json").write_text(json.dumps(table))
    found = named_joints(strange, read_joint_map(tmp_path / "map.json"))
    same_motion(skeleton_params(strange, found, shaped(None)), walk(None))
    (tmp_path / "map.json").write_text(json.dumps({"bone0": "tail"}))
    with pytest.raises(InputError, match="tail"):
        read_joint_map(tmp_path / "map.json")
    with pytest.raises(InputError, match="wing"):
        named_joints(strange, {"wing": "pelvis"})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text[: len(text) // 2], "frames of"),
        (lambda text: text.replace("HIERARCHY", "SKELETON"), "HIERARCHY"),
        (lambda text: text.replace("}", "", 1), "}"),
        (lambda text: text.replace("Zrotation", "Wrotation", 1), "channels"),
        (lambda text: text.replace("JOINT left_hip", "JOINT right_hip", 1), "different names"),
        (lambda text: text.replace("Frame Time: 0.0", "Frame Time: -0.0"), "positive frame time"),
        (lambda text: text.replace("OFFSET", "OFFSET nan", 1), "within"),
        (lambda text: text.rsplit(" ", 1)[0] + " inf\n", "within"),
        # What Python takes for numbers, and no other program does.
        (lambda text: text.rsplit(" ", 1)[0] + " 1_0\n", "numbers after Frame Time"),
        (lambda text: text.replace("OFFSET ", "OFFSET \u0661", 1), "a number, received \u0661"),
    ],
)
def test_damaged_files_are_refused(file, tmp_path, change, words):
    (tmp_path / "a.bvh").write_text(change(file.read_text()))
    with pytest.raises(InputError, match=words):
        read_bvh(tmp_path / "a.bvh")


def test_a_shape_has_its_own_joints():
    tall = Skeleton.of(load_body(), betas(1))
    assert abs(tall.leg - shaped(None).leg) > 0.02
    truth = load_body().forward(replace(walk(None), betas=np.repeat(betas(1)[None], len(walk(None)), axis=0)))
    np.testing.assert_allclose(tall.pose(walk(None))[:, :22], truth.joints[:, :22], atol=1e-9)
