"""Names of other programs: a bijection over the joints, in the order of parents that each program has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.layout import NAME_SCHEMES, PROGRAMS, SMPLX_JOINTS, names_of_joints
from smplxpp.body.retarget import Skeleton
from smplxpp.body.skeleton_params import load_skeleton
from smplxpp.core import InputError
from smplxpp.export.gltf_skin import with_joint_names
from smplxpp.export.motion_files import write_bvh
from tests.export.glb_reader import GlbReader
from tests.export.templates import open_body_template, random_motion, random_template

# Chains of each program's skeleton from the root out, as its own documentation has them; L and R are written by hand
# for one side, the other follows by `MIRROR`. A joint that the program does not have is left out.
CHAINS = {
    "mixamo": (
        "Hips Spine Spine1 Spine2 Neck Head",
        "Spine2 LeftShoulder LeftArm LeftForeArm LeftHand",
        "LeftHand LeftHandThumb1 LeftHandThumb2 LeftHandThumb3",
        "LeftHand LeftHandPinky1 LeftHandPinky2 LeftHandPinky3",
        "LeftHand LeftHandRing1 LeftHandRing2 LeftHandRing3",
        "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase",
    ),
    "unity": (
        "Hips Spine Chest UpperChest Neck Head Jaw",
        "Head LeftEye",
        "UpperChest LeftShoulder LeftUpperArm LeftLowerArm LeftHand",
        "LeftHand LeftThumbProximal LeftThumbIntermediate LeftThumbDistal",
        "LeftHand LeftLittleProximal LeftLittleIntermediate LeftLittleDistal",
        "LeftHand LeftMiddleProximal LeftMiddleIntermediate LeftMiddleDistal",
        "Hips LeftUpperLeg LeftLowerLeg LeftFoot LeftToes",
    ),
    "unreal": (
        "pelvis spine_01 spine_02 spine_03 neck_01 head",
        "spine_03 clavicle_l upperarm_l lowerarm_l hand_l",
        "hand_l thumb_01_l thumb_02_l thumb_03_l",
        "hand_l pinky_01_l pinky_02_l pinky_03_l",
        "hand_l index_01_l index_02_l index_03_l",
        "pelvis thigh_l calf_l foot_l ball_l",
    ),
    "vrm": (
        "hips spine chest upperChest neck head jaw",
        "head leftEye",
        "upperChest leftShoulder leftUpperArm leftLowerArm leftHand",
        "leftHand leftThumbMetacarpal leftThumbProximal leftThumbDistal",
        "leftHand leftLittleProximal leftLittleIntermediate leftLittleDistal",
        "leftHand leftRingProximal leftRingIntermediate leftRingDistal",
        "hips leftUpperLeg leftLowerLeg leftFoot leftToes",
    ),
}
MIRROR = (("Left", "Right"), ("left", "right"), ("_l", "_r"))
# Names that stay: those that the program does not have, and those that it calls as we do.
KEPT = {
    "mixamo": {"jaw"},
    "unity": set(),
    "unreal": {"pelvis", "head", "jaw", "left_eye_smplhf", "right_eye_smplhf"},
    "vrm": {"neck", "head", "jaw"},
}


def mirrored(chain: str) -> str:
    for one, other in MIRROR:
        chain = chain.replace(one, other)
    return chain


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_joint_has_one_name_under_the_parent_that_the_program_expects(program):
    body = load_body()
    names = names_of_joints(body.joint_names, program)
    assert len(set(names)) == len(names) == 55
    assert {own for own, name in zip(body.joint_names, names, strict=True) if own == name} == KEPT[program]
    plain = [name.removeprefix("mixamorig:") for name in names]
    assert all(name.startswith("mixamorig:") for name in names if name != "jaw") or program != "mixamo"
    parent = {name: plain[p] if p >= 0 else None for name, p in zip(plain, body.parents, strict=True)}
    for chain in (*CHAINS[program], *map(mirrored, CHAINS[program])):
        bones = chain.split()
        assert [parent[bone] for bone in bones[1:]] == bones[:-1]
    # Left joints lie on +x, where the person who looks along +z has her left.
    joints = open_body_template().joints
    hand = next(k for k, name in enumerate(plain) if name in ("LeftHand", "hand_l", "leftHand"))
    assert joints[hand, 0] > 0.4


def test_names_change_a_file_and_nothing_that_moves_in_it(tmp_path):
    template, motion = open_body_template(), replace(random_motion(2, expressions=52), flat_hand_mean=True)
    template = replace(template, body=replace(template.body, posedirs=None))
    template.export(tmp_path / "a.glb", animation=motion, joint_names="mixamo")
    reader = GlbReader(tmp_path / "a.glb")
    (skin,) = reader.json["skins"]
    assert reader.json["nodes"][skin["joints"][16]]["name"] == "mixamorig:LeftArm"
    np.testing.assert_allclose(reader.posed("body", frame=1), template.pose(motion)[1], atol=5e-6)


@pytest.mark.parametrize("scheme", ["mixamo", "unreal"])
def test_a_motion_with_their_names_plays(tmp_path, scheme):
    """As a BVH of Mixamo or Unreal does: our reader of other programs' skeletons finds every limb and finger."""
    body = load_body()
    still = {name: np.zeros((3, 3)) for name in ("jaw_pose", "leye_pose", "reye_pose")}
    motion = replace(random_motion(3, expressions=0, fps=30.0), flat_hand_mean=True, **still)
    names = names_of_joints(body.joint_names, scheme)
    write_bvh(tmp_path / "a.bvh", replace(body, joint_names=names), motion)
    played = load_skeleton(tmp_path / "a.bvh", Skeleton.of(body))
    # A reader puts the person on the floor of its own: joints are compared about the pelvis.
    found, expected = (body.forward(params).joints for params in (played, motion))
    found, expected = (joints - joints[:, :1] for joints in (found, expected))
    np.testing.assert_allclose(found[:, :22], expected[:, :22], atol=1e-3)
    np.testing.assert_allclose(found[:, 25:], expected[:, 25:], atol=1e-3)


def test_a_skeleton_of_another_kind_and_another_program_are_refused():
    assert NAME_SCHEMES == ("smplx", *PROGRAMS)
    assert names_of_joints(SMPLX_JOINTS, "smplx") == SMPLX_JOINTS
    with pytest.raises(InputError, match="joints of the SMPL family, to name them as unity does"):
        with_joint_names(random_template(), "unity")
    with pytest.raises(InputError, match="mixamo"):
        names_of_joints(SMPLX_JOINTS, "maya")
