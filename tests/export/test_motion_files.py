"""Motions as BVH and AMASS: read by others, and back by our own importer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smplxpp.body import load_body, load_params
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec
from smplxpp.export.motion_files import euler_zxy, write_amass, write_bvh
from tests.export.templates import random_motion


@pytest.fixture(scope="module")
def motion() -> BodyParams:
    """Turning all joints, walking, with hands and without a face."""
    params = random_motion(6, expressions=0)
    transl = np.linspace((0.1, 1.0, -0.4), (0.5, 0.9, 0.3), 6)
    return replace(params, transl=transl, fps=24.0, betas=np.zeros((6, 0)), flat_hand_mean=False)


def test_bvhio_finds_the_joints_where_we_do(tmp_path, motion):
    bvhio = pytest.importorskip("bvhio")
    body = load_body()
    write_bvh(tmp_path / "a.bvh", body, motion)
    joints = body.forward(motion).joints
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    nodes = {node.Name: node for node, _, _ in root.layout()}
    assert set(nodes) == set(body.joint_names)
    for k in range(len(motion)):
        root.loadPose(k)
        theirs = np.array([[*nodes[name].PositionWorld] for name in body.joint_names])
        np.testing.assert_allclose(theirs / 100.0, joints[k], atol=2e-5)


def test_a_bvh_says_what_bvh_says(tmp_path, motion):
    """Grammar and order of channels, read here by hand."""
    body = load_body()
    write_bvh(tmp_path / "a.bvh", body, motion)
    text = (tmp_path / "a.bvh").read_text()
    words = text.split("MOTION")[0].split()
    names = [words[k + 1] for k, word in enumerate(words) if word in ("ROOT", "JOINT")]
    assert words[0] == "HIERARCHY" and words.count("{") == words.count("}") == 55 + words.count("End")
    assert sorted(names) == sorted(body.joint_names) and names[0] == "pelvis"
    channels = [words[k + 1 : k + 2 + int(words[k + 1])] for k, word in enumerate(words) if word == "CHANNELS"]
    assert channels[0] == "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation".split()
    assert all(row == "3 Zrotation Xrotation Yrotation".split() for row in channels[1:])
    lines = text.split("MOTION\n")[1].splitlines()
    assert lines[0] == "Frames: 6" and float(lines[1].split(":")[1]) == pytest.approx(1 / 24, abs=1e-8)
    values = np.array([line.split() for line in lines[2:]], float)
    assert values.shape == (6, 3 + 3 * 55)
    np.testing.assert_allclose(values[:, :3], 100 * body.forward(motion).joints[:, 0], atol=1e-5)
    at = names.index("left_elbow")
    turn = Rotation.from_euler("ZXY", values[:, 3 + 3 * at : 6 + 3 * at], degrees=True).as_matrix()
    ours = matrix_from_rotvec(motion.body_pose.reshape(6, 21, 3)[:, body.joint_names.index("left_elbow") - 1])
    np.testing.assert_allclose(turn, ours, atol=1e-7)


def test_angles_do_not_jump_and_stand_a_locked_gimbal():
    turns = np.linspace(0.0, 4 * np.pi, 80)
    axes = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    rotations = matrix_from_rotvec(turns[:, None, None] * axes)
    angles = euler_zxy(rotations)
    again = Rotation.from_euler("ZXY", angles.reshape(-1, 3), degrees=True).as_matrix().reshape(rotations.shape)
    np.testing.assert_allclose(again, rotations, atol=1e-7)
    assert np.abs(np.diff(angles[:, :2], axis=0)).max() < 20
    locked = matrix_from_rotvec(np.array([[[np.pi / 2, 0.0, 0.0]], [[-np.pi / 2, 0.0, 0.0]]]))
    locked = locked @ matrix_from_rotvec(np.array([0.0, 0.7, 0.0]))
    again = Rotation.from_euler("ZXY", euler_zxy(locked).reshape(-1, 3), degrees=True).as_matrix()
    np.testing.assert_allclose(again, locked[:, 0], atol=1e-6)


def test_amass_has_its_layout_and_comes_back(tmp_path, motion):
    body = load_body()
    write_amass(tmp_path / "a_stageii.npz", body, motion)
    with np.load(tmp_path / "a_stageii.npz") as stored:
        shapes = {name: stored[name].shape for name in stored.files}
        assert shapes["poses"] == (6, 165) and shapes["betas"] == (16,) and shapes["trans"] == (6, 3)
        assert (str(stored["gender"]), str(stored["surface_model_type"])) == ("neutral", "smplx")
        assert float(stored["mocap_frame_rate"]) == 24.0 and float(stored["mocap_time_length"]) == 0.25
        pieces = [stored[name] for name in ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")]
        np.testing.assert_array_equal(np.hstack(pieces), stored["poses"])
        # +Z is up: the joints of who stands upright lie in it.
        z_up = BodyParams.from_full_pose(
            stored["poses"].reshape(6, 55, 3), betas=np.zeros(0), expression=np.zeros(0), transl=stored["trans"]
        )
    ours, theirs = body.forward(motion).joints, body.forward(replace(z_up, flat_hand_mean=True)).joints
    np.testing.assert_allclose(theirs, np.stack([ours[..., 0], -ours[..., 2], ours[..., 1]], axis=-1), atol=1e-9)
    back = load_params(tmp_path / "a_stageii.npz", body=body, up="z")
    assert back.fps == 24.0 and back.flat_hand_mean
    np.testing.assert_allclose(body.forward(back).vertices, body.forward(motion).vertices, atol=1e-9)


def test_smplh_has_its_own_layout(tmp_path, motion):
    body = load_body()
    kept = np.r_[0:22, 25:55]
    parents = np.searchsorted(kept, body.parents[kept])
    parents[0] = -1
    smplh = replace(
        body,
        parents=parents,
        joint_names=tuple(body.joint_names[k] for k in kept),
        joint_regressor=body.joint_regressor[kept],
        weights=body.weights[:, kept] / body.weights[:, kept].sum(axis=1, keepdims=True).clip(1e-9),
        posedirs=None,
    )
    write_amass(tmp_path / "a.npz", smplh, motion)
    back = load_params(tmp_path / "a.npz", body=smplh, up="z")
    assert back.fps == 24.0
    np.testing.assert_allclose(smplh.forward(back).joints, smplh.forward(motion).joints, atol=1e-9)


def test_motions_that_cannot_be_written_are_refused(tmp_path, motion):
    body = load_body()
    for write in (write_bvh, write_amass):
        with pytest.raises(InputError, match="frames a second"):
            write(tmp_path / "a", body, replace(motion, fps=-3.0))
        with pytest.raises(InputError, match="one frame"):
            write(tmp_path / "a", body, motion.select([]))
    with pytest.raises(InputError, match="betas"):
        write_amass(tmp_path / "a", body, replace(motion, betas=np.ones((6, 20))))
    assert list(tmp_path.iterdir()) == []
