"""Rigged GLBs held against what engines that are not at hand document of their importers.

Unity's Humanoid (manual, "Creating models for animation" and `HumanTrait.RequiredBone`): fifteen bones, each above the
next in this order, one name each, in a T-pose. Unreal (documentation, "Skeletons", and its mannequin): one root bone at
the origin, named `root`, between the soles, with the mannequin's names below it. Both: a metre is 1, nothing is scaled.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pygltflib
import pytest

from tests.export.templates import open_body_template

REQUIRED = {
    "unity": (
        "Hips Spine Head",
        "Hips LeftUpperLeg LeftLowerLeg LeftFoot",
        "Spine LeftUpperArm LeftLowerArm LeftHand",
    ),
    "unreal": (
        "root pelvis spine_01 spine_02 spine_03 neck_01 head",
        "spine_03 clavicle_l upperarm_l lowerarm_l hand_l",
        "pelvis thigh_l calf_l foot_l ball_l",
    ),
    "mixamo": (
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head",
        "mixamorig:Spine2 mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand",
        "mixamorig:Hips mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase",
    ),
}
ARMS = {
    "unity": "LeftUpperArm LeftLowerArm LeftHand",
    "unreal": "upperarm_l lowerarm_l hand_l",
    "mixamo": "mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand",
}


def mirrored(names: str) -> str:
    return names.replace("Left", "Right").replace("_l", "_r")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder, template = tmp_path_factory.mktemp("engines"), open_body_template()
    return {name: template.export(folder / f"{name}.glb", joint_names=name) for name in REQUIRED}


@pytest.mark.parametrize("engine", REQUIRED)
def test_the_rig_is_one_that_the_engine_documents(files, engine):
    gltf = pygltflib.GLTF2().load(files[engine])
    (skin,) = gltf.skins
    above = {child: k for k, node in enumerate(gltf.nodes) for child in node.children or ()}
    bones = [skin.skeleton, *skin.joints]
    named = {gltf.nodes[k].name: k for k in bones}
    assert len(named) == len(bones), "one name each"

    def ancestors(k: int) -> list[int]:
        return [k, *ancestors(above[k])] if k in above else [k]

    # Nothing is turned or scaled, so that a bone stands at the sum of its ancestors' offsets, in metres.
    assert not any(node.rotation or node.scale or node.matrix for node in gltf.nodes)
    place = {
        name: sum(np.array(gltf.nodes[one].translation or [0.0] * 3) for one in ancestors(k))
        for name, k in named.items()
    }
    for chain in REQUIRED[engine]:
        for names in (chain.split(), mirrored(chain).split()):
            for parent, child in pairwise(names):
                assert named[parent] in ancestors(named[child])[1:], (parent, child)
    # One root, on the floor between the feet: the node above all bones, which only Unreal has a name for.
    assert skin.skeleton not in above
    np.testing.assert_array_equal(place[gltf.nodes[skin.skeleton].name], 0.0)
    assert engine != "unreal" or gltf.nodes[skin.skeleton].name == "root"
    lowest = min(gltf.accessors[part.attributes.POSITION].min[1] for mesh in gltf.meshes for part in mesh.primitives)
    assert abs(lowest) < 1e-5
    # The T: arms within 10 degrees of the x axis, the left one on +x, facing +z as glTF has it.
    for names, sign in ((ARMS[engine], 1.0), (mirrored(ARMS[engine]), -1.0)):
        points = np.array([place[name] for name in names.split()])
        along = np.diff(points, axis=0) / np.linalg.norm(np.diff(points, axis=0), axis=1, keepdims=True)
        assert (sign * along[:, 0] > np.cos(np.radians(10.0))).all()
