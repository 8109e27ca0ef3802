"""Names that other programs give to the joints of the SMPL family.

Sources: names of Mixamo's automatic rig; Unity's enumeration `HumanBodyBones`; the skeleton of Unreal's mannequins
(`SK_Mannequin`; Manny has two more joints of the spine and one more of the neck); the humanoid bones of VRM 1.0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from smplxpp.body.layout import FINGERS, SMPLX_JOINTS
from smplxpp.core import InputError, require_choice
from smplxpp.template.template import Template

OWN = "smplx"
"""The scheme that keeps the body's own names."""
PROGRAMS = ("mixamo", "unity", "unreal", "vrm")
SCHEMES = (OWN, *PROGRAMS)
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


def _table() -> dict[str, dict[str, str]]:
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


NAMES = _table()
"""By program, the name of each of our joints that it knows; Mixamo's without the prefix of its name space."""
PREFIXES = {"mixamo": "mixamorig:"}
"""Name space before the names of a program."""


def names_of_joints(joint_names: Sequence[str], scheme: str) -> tuple[str, ...]:
    """Return the names that a program gives to joints; a joint that it has no name for keeps its own.

    Args:
        joint_names: of the body, as SMPL-X calls them.
        scheme: one of `SCHEMES`.

    Raises:
        InputError: another scheme, or a body without any joint of the SMPL family.

    Example:
        >>> from smplxpp.export.joint_names import names_of_joints
        >>> names_of_joints(["pelvis", "left_hip", "jaw"], "mixamo")
        ('mixamorig:Hips', 'mixamorig:LeftUpLeg', 'jaw')
    """
    require_choice("joint names", scheme, SCHEMES)
    if scheme == OWN:
        return tuple(joint_names)
    if not set(joint_names) & set(SMPLX_JOINTS):
        raise InputError(
            "joint names",
            expected=f"joints of the SMPL family, to name them as {scheme} does",
            received=", ".join(joint_names[:3]),
            remedy=f"keep the body's own with {OWN!r}",
        )
    prefix, known = PREFIXES.get(scheme, ""), NAMES[scheme]
    return tuple(f"{prefix}{known[name]}" if name in known else name for name in joint_names)


def with_joint_names(template: Template, scheme: str) -> Template:
    """Return the template with its joints named by `names_of_joints`.

    Raises:
        InputError: another scheme, or a body without any joint of the SMPL family.
    """
    if scheme == OWN:
        return template
    return replace(
        template, body=replace(template.body, joint_names=names_of_joints(template.body.joint_names, scheme))
    )
