"""Where names of keypoints are on a body: against the file's own regressors, joints and what a hand looks like."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.layout import VOCABULARY
from smplxpp.core.params import BodyParams
from smplxpp.register.landmarks import LandmarkModel


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def posed(body):
    rng = np.random.default_rng(2)
    pose = rng.normal(0, 0.3, (3, 55, 3))
    betas, nothing = rng.normal(0, 1, (3, 20)), np.zeros((3, 52))
    return body.forward(
        BodyParams.from_full_pose(pose, betas=betas, expression=nothing, transl=rng.normal(size=(3, 3)))
    )


def test_every_name_that_a_detector_gives_is_on_the_open_body(body, posed):
    model = LandmarkModel.of(body, sorted(VOCABULARY))
    assert model.unknown == () and set(model.names) == VOCABULARY and len(VOCABULARY) == 55 + 23 + 10 + 51
    vertex = model.joint_index < 0
    np.testing.assert_allclose(model.vertex_weight.sum(axis=1), vertex)
    points = model.points(posed.vertices[0], posed.joints[0])
    wrist = body.joint_names.index("left_wrist")
    assert (points[model.names.index("left_wrist")] == posed.joints[0, wrist]).all()


def test_coco_points_are_the_files_regressor_in_any_pose_and_shape(body, posed):
    """Only some of its vertices are used: within a fifth of a millimetre."""
    with (
        resources.as_file(resources.files("smplxpp") / "data" / "open_body.npz") as path,
        np.load(path, allow_pickle=False) as data,
    ):
        names, regressor = data["coco_names"].tolist(), data["coco_regressor"].astype(np.float64)
    split = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    ours = [("coco_" if name.endswith(split) else "") + name for name in names]
    model = LandmarkModel.of(body, ours)
    assert model.names == tuple(ours) and model.vertex_index.shape[1] <= 64
    for vertices, joints in zip(posed.vertices, posed.joints, strict=True):
        expected = regressor / regressor.sum(axis=1, keepdims=True) @ vertices
        assert np.linalg.norm(model.points(vertices, joints) - expected, axis=1).max() < 2e-4


def test_fingertips_lie_beyond_the_last_joint(body):
    fingers = [
        f"{side}_{finger}" for side in ("left", "right") for finger in ("index", "middle", "pinky", "ring", "thumb")
    ]
    model = LandmarkModel.of(body, [f"{finger}_tip" for finger in fingers])
    joints = body.joint_regressor @ body.v_template
    tips = model.points(body.v_template, joints)
    for finger, tip in zip(fingers, tips, strict=True):
        second, last = (joints[body.joint_names.index(f"{finger}{k}")] for k in (2, 3))
        bone = (last - second) / np.linalg.norm(last - second)
        beyond = (tip - last) @ bone
        assert 0.012 < beyond < 0.04 and np.linalg.norm(tip - last - beyond * bone) < 0.012, finger


def test_faces_are_dlibs(body):
    model = LandmarkModel.of(body, [f"face_{k}" for k in (30, 36, 45, 57)])
    nose, right_eye, left_eye, lip = model.points(body.v_template, np.zeros((55, 3)))
    assert right_eye[0] < -0.02 < 0.02 < left_eye[0] and lip[1] < nose[1] < left_eye[1] and nose[2] > left_eye[2]


def test_a_body_without_regressors_names_what_it_lacks(body):
    """As SMPL-X's own files: a face, no COCO points."""
    faces = {name: mean for name, mean in body.landmarks.items() if name.startswith("face_")}
    bare = replace(body, landmarks=faces)
    asked = ["coco_left_hip", "nose", "left_eye", "left_ear", "right_heel", "face_17", "something"]
    model = LandmarkModel.of(bare, asked)
    assert model.names == ("coco_left_hip", "nose", "left_eye", "face_17")
    assert model.unknown == ("left_ear", "right_heel", "something")
    joints = [body.joint_names[k] if k >= 0 else "" for k in model.joint_index]
    assert joints == ["left_hip", "", "left_eye_smplhf", ""]
    nothing = LandmarkModel.of(replace(body, landmarks={}), ["pelvis", "nose"])
    assert nothing.names == ("pelvis",) and nothing.points(body.v_template, np.ones((55, 3))).tolist() == [[1, 1, 1]]
