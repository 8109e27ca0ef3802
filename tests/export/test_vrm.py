"""VRM 1.0: rules of its specification without the network; three-vrm and Khronos's validator where they are at hand.

`npm install --prefix FOLDER gltf-validator three @pixiv/three-vrm`, then `NODE_PATH=FOLDER/node_modules pytest`.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar.speech import ARTICULATORS, Face
from avatar.speech.coarticulation import VISEMES
from smplxpp.core import BodyParams, InputError
from smplxpp.export.vrm import LICENCE, checked_meta, in_vrm_pose, preset_displacements
from smplxpp.template.template import Template
from tests.export.glb_reader import GlbReader
from tests.export.templates import open_body_template, random_template, with_part
from tests.export.test_glb_validator import validate

LOADER = Path(__file__).with_name("load_vrm.mjs")
# The parent of each bone, or of the nearest bone above it that the model has (VRMC_vrm, humanoid.md).
PARENTS = {
    **{"spine": "hips", "chest": "spine", "upperChest": "chest", "neck": "upperChest", "head": "neck", "jaw": "head"},
    **{f"{side}{bone}": parent for side in ("left", "right") for bone, parent in {"Eye": "head"}.items()},
    **{f"{side}Shoulder": "upperChest" for side in ("left", "right")},
    **{f"{side}UpperLeg": "hips" for side in ("left", "right")},
    **{
        f"{side}{bone}": f"{side}{parent}"
        for side in ("left", "right")
        for bone, parent in {
            **{"UpperArm": "Shoulder", "LowerArm": "UpperArm", "Hand": "LowerArm"},
            **{"LowerLeg": "UpperLeg", "Foot": "LowerLeg", "Toes": "Foot"},
            **{"ThumbMetacarpal": "Hand", "ThumbProximal": "ThumbMetacarpal", "ThumbDistal": "ThumbProximal"},
            **{f"{finger}Proximal": "Hand" for finger in ("Index", "Middle", "Ring", "Little")},
            **{f"{finger}Intermediate": f"{finger}Proximal" for finger in ("Index", "Middle", "Ring", "Little")},
            **{f"{finger}Distal": f"{finger}Intermediate" for finger in ("Index", "Middle", "Ring", "Little")},
        }.items()
    },
}


@pytest.fixture(scope="module")
def bearded() -> Template:
    """The open body with a part that hangs on its jaw: 60 faces of the chin, a centimetre before it."""
    body = open_body_template()
    chin = body.weights.dense()[:, body.body.joint_names.index("jaw")] > 0.99
    return with_part(body, "beard", 1, body.faces[chin[body.faces].all(axis=1)][:60], 0.01)


@pytest.fixture(scope="module")
def written(bearded, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("vrm") / "anna.vrm"
    bearded.export(path, meta={"authors": ["Anna", "Ben"], "commercialUsage": "personalProfit"}, joint_names="mixamo")
    return path


def test_a_vrm_says_what_the_specification_asks_for(written):
    reader = GlbReader(written)
    nodes, said = reader.json["nodes"], reader.json["extensions"]["VRMC_vrm"]
    assert reader.json["extensionsUsed"] == ["VRMC_vrm"] and said["specVersion"] == "1.0"
    assert said["meta"]["name"] == "anna" and said["meta"]["authors"] == ["Anna", "Ben"]
    assert said["meta"]["licenseUrl"] == LICENCE and said["meta"]["commercialUsage"] == "personalProfit"
    # Every bone once, each under the bone that the specification puts above it.
    bones = {name: bone["node"] for name, bone in said["humanoid"]["humanBones"].items()}
    above = {child: k for k, node in enumerate(nodes) for child in node.get("children", ())}
    assert set(bones) == PARENTS.keys() | {"hips"} and len(set(bones.values())) == 55
    assert all(above[bones[bone]] == bones[parent] for bone, parent in PARENTS.items())
    assert nodes[bones["leftUpperArm"]]["name"] == "mixamorig:LeftArm"
    # Expressions point at targets that are there; the beard goes with the jaw.
    assert {"aa", "ih", "ou", "ee", "oh", "blink", "happy"} < said["expressions"]["preset"].keys()
    assert "jawOpen" in said["expressions"]["custom"] and "tongueOut" not in said["expressions"]["custom"]
    for expression in [*said["expressions"]["preset"].values(), *said["expressions"]["custom"].values()]:
        for bind in expression["morphTargetBinds"]:
            (primitive,) = reader.json["meshes"][nodes[bind["node"]]["mesh"]]["primitives"]
            assert bind["index"] < len(primitive["targets"]) and bind["weight"] == 1.0
    moved = {
        name: [nodes[b["node"]]["name"] for b in e["morphTargetBinds"]]
        for name, e in said["expressions"]["preset"].items()
    }
    assert moved["aa"] == ["body", "beard"] and moved["blink"] == ["body"]
    for mesh in reader.json["meshes"]:
        assert "WEIGHTS_1" not in mesh["primitives"][0]["attributes"]
    assert said["lookAt"]["type"] == "bone" and said["lookAt"]["offsetFromHeadBone"][2] > 0.05
    # On the floor, looking along +Z.
    places = reader.array(reader.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    assert abs(places[:, 1].min()) < 1e-6 and said["firstPerson"]["meshAnnotations"][1]["type"] == "auto"


def test_the_rest_pose_is_vrms(bearded):
    posed = in_vrm_pose(bearded)
    names, joints = list(posed.body.joint_names), posed.joints
    for a, b, towards in (
        ("left_shoulder", "left_elbow", (1, 0, 0)),
        ("right_wrist", "right_middle1", (-1, 0, 0)),
        ("left_pinky2", "left_pinky3", (1, 0, 0)),
        ("right_thumb1", "right_thumb2", (-(0.5**0.5), 0, 0.5**0.5)),
    ):
        bone = joints[names.index(b)] - joints[names.index(a)]
        np.testing.assert_allclose(bone / np.linalg.norm(bone), towards, atol=1e-9)
    foot = joints[names.index("left_foot")] - joints[names.index("left_ankle")]
    assert abs(foot[0]) < 1e-9 < foot[2]
    # Bones keep their lengths, faces their expressions, and the eyes their places in them.
    parents = posed.body.parents[1:]
    lengths = [np.linalg.norm(x[1:] - x[parents], axis=1) for x in (joints, bearded.joints)]
    np.testing.assert_allclose(*lengths, atol=1e-9)
    smile = replace(BodyParams.rest(betas=0, expressions=52), expression=np.full((1, 52), 0.5))
    before, after = (t.body.forward(smile).rest_joints - t.joints for t in (bearded, posed))
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_vowels_are_those_of_speech():
    template = open_body_template()
    face = Face.of(template.body.expression_names, template.body.joint_names)
    presets = preset_displacements(template)
    for preset, phoneme in {"aa": "AA", "ih": "IY", "ou": "UW", "ee": "E", "oh": "O"}.items():
        curves = np.zeros((1, len(ARTICULATORS)))
        for name, (value, _) in VISEMES[phoneme].items():
            curves[0, ARTICULATORS.index(name)] = value
        expression, jaw = face.pose(curves, np.zeros(1))
        rest = BodyParams.rest(betas=0, expressions=52)
        spoken = replace(rest, expression=expression, jaw_pose=jaw, flat_hand_mean=True)
        moved = template.pose(spoken)[0] - template.vertices
        assert np.abs(moved).max() > 0.003
        # Within what is left out of a morph target.
        np.testing.assert_allclose(presets[preset], moved, atol=2e-5)


@pytest.mark.long
def test_a_body_with_numbered_expressions_blinks_and_speaks(tmp_path):
    """SMPL-X's expressions have no names, and its file none of eyes and teeth: ARKit's are solved for.

    Here they are mixtures of the named ones. A face without labels was found to be empty before.
    """
    template, rng = open_body_template(), np.random.default_rng(0)
    body = template.body
    mixed = body.exprdirs @ np.linalg.qr(rng.normal(size=(52, 52)))[0]
    unlabelled = {"part_labels": body.weights.argmax(axis=1), "part_label_names": body.joint_names}
    numbered = replace(template, body=replace(body, exprdirs=mixed, expression_names=(), **unlabelled))
    numbered.export(tmp_path / "a.vrm")
    reader, named = GlbReader(tmp_path / "a.vrm"), preset_displacements(template)
    said = reader.json["extensions"]["VRMC_vrm"]["expressions"]
    assert said["preset"].keys() == named.keys() and len(said["custom"]) > 45
    targets, names = (reader.json["meshes"][0][k] for k in ("primitives", "extras"))
    targets, names = targets[0]["targets"], names["targetNames"]
    wanted = named | {name: body.exprdirs[..., body.expression_names.index(name)] for name in ("jawOpen", "mouthLeft")}
    for kind, name in (("preset", "aa"), ("preset", "blink"), ("custom", "jawOpen"), ("custom", "mouthLeft")):
        (bind,) = said[kind][name]["morphTargetBinds"]
        error = np.linalg.norm(reader.array(targets[bind["index"]]["POSITION"]) - wanted[name], axis=1).max()
        assert error < 0.4 * np.linalg.norm(wanted[name], axis=1).max(), name
        assert names[bind["index"]] == name
    # A GLB keeps the numbered ones, which its motions are in, before those with names.
    numbered.export(tmp_path / "a.glb")
    told = GlbReader(tmp_path / "a.glb").json["meshes"][0]["extras"]["targetNames"]
    assert told[:52] == [f"expression_{k:02d}" for k in range(52)] and set(told[52:]) == set(said["custom"])


def test_terms_are_restrictive_and_checked(tmp_path):
    stated = checked_meta(None, name="me")
    assert stated["avatarPermission"] == "onlyAuthor" and stated["modification"] == "prohibited"
    assert not any(value for key, value in stated.items() if key.startswith("allow"))
    for meta, match in (
        ({"licence": "MIT"}, "expected one of name, version"),
        ({"licenseUrl": "MIT"}, r"licenseUrl: expected an address, https://\.\.\., received 'MIT'"),
        ({"authors": []}, "authors: expected one or more texts"),
        ({"modification": "yes"}, "prohibited or allowModification"),
        ({"allowRedistribution": "no"}, "true or false"),
    ):
        with pytest.raises(InputError, match=match):
            random_template().export(tmp_path / "a.vrm", meta=meta)
    with pytest.raises(InputError, match="skeleton for VRM"):
        random_template().export(tmp_path / "a.vrm")
    with pytest.raises(InputError, match="at most 0 frames"):
        open_body_template().export(tmp_path / "a.vrm", animation=BodyParams.rest(betas=0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_khronos_validator_knows_no_fault(written):
    report = validate(written)
    assert [one["code"] for one in report["issues"]["messages"]] == ["UNSUPPORTED_EXTENSION"]  # a remark, on VRMC_vrm


def test_three_vrm_poses_it_as_we_do(written, bearded):
    """Another program's bones, expressions, gaze and skinning against ours."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    run = subprocess.run(["node", str(LOADER), str(written)], capture_output=True, text=True, timeout=900, check=False)
    if run.returncode == 3:
        pytest.skip("the npm packages three and @pixiv/three-vrm are not in NODE_PATH")
    assert run.returncode == 0, run.stderr[-2000:]
    found = json.loads(run.stdout)
    assert found["warnings"] == [] and found["meta"]["authors"] == ["Anna", "Ben"] and len(found["bones"]) == 55
    ours = in_vrm_pose(bearded).on_floor()
    ours = replace(ours, weights=ours.weights.pruned(4), body=replace(ours.body, posedirs=None))
    rows = {name: ours.vertex_part == k for k, name in enumerate(ours.part_names)}
    np.testing.assert_allclose(found["bones"]["leftHand"], ours.joints[20], atol=1e-6)
    down = BodyParams.rest(betas=0, expressions=0)
    pose = np.zeros((1, 55, 3))
    pose[0, 16, 2] = -1.2
    down = BodyParams.from_full_pose(
        pose, betas=np.zeros((1, 2)), expression=np.zeros((1, 52)), transl=np.zeros((1, 3))
    )
    posed = ours.pose(replace(down, flat_hand_mean=True))[0]
    spoken = ours.vertices + preset_displacements(ours)["aa"]
    for name, own in rows.items():
        for kind, wanted in (("rest", ours.vertices), ("arm", posed)):
            np.testing.assert_allclose(np.reshape(found[kind][name], (-1, 3)), wanted[own], atol=2e-6)
        after = np.reshape(found["expressions"]["aa"]["vertices"][name], (-1, 3))
        np.testing.assert_allclose(after, spoken[own], atol=2e-6)
    # 10 degrees to the person's left, 5 downwards.
    yaw, pitch = np.radians([10.0, 5.0])
    wanted = [np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
    np.testing.assert_allclose(found["gaze"], wanted, atol=2e-3)
