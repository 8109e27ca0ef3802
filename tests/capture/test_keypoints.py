"""Keypoints of a capture follow its images: lens, size, window, what is left out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.cli import main
from smplxpp.body import load_body
from smplxpp.capture import Problem, find_problems, open_capture
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.writers import write_keypoints
from smplxpp.core import InputError, Keypoints2D
from tests.capture.scene import LENS, Scene, make_scene
from tests.capture.writers import write_easymocap, write_simple

JOINTS = ("pelvis", "left_wrist", "right_wrist", "head", "left_ankle")


def joints(scene: Scene) -> np.ndarray:
    """(F, K, 3) joints of the scene."""
    body = load_body()
    return body.forward(scene.params).joints[:, [body.joint_names.index(name) for name in JOINTS]]


def on_disk(scene: Scene, camera: str) -> np.ndarray:
    """(F, K, 2) pixels of the recorded image, through the lens if there is one."""
    pinhole = scene.cameras[camera]
    points = joints(scene).reshape(-1, 3)
    if scene.lens is None:
        return pinhole.screen_from_world(points)[:, :2].reshape(2, -1, 2)
    cam = points @ pinhole.cam_from_world[:3, :3].T + pinhole.cam_from_world[:3, 3]
    lens = Distortion.from_opencv(scene.lens, subject="")
    assert lens is not None
    bent = lens.distort(cam[:, :2] / cam[:, 2:])
    return (bent @ pinhole.K[:2, :2].T + pinhole.K[:2, 2]).reshape(2, -1, 2)


@pytest.fixture
def with_lens(tmp_path) -> tuple[Scene, Path]:
    scene = make_scene(lens=LENS)
    root = write_simple(scene, tmp_path / "capture")
    for name in scene.cameras:
        confidence = np.full((2, len(JOINTS)), 0.5)
        found = Keypoints2D(JOINTS, np.arange(2), on_disk(scene, name), confidence)
        write_keypoints(root / "keypoints" / f"{name}.npz", found)
    return scene, root


def projected(capture, scene: Scene, camera: str) -> np.ndarray:
    points = joints(scene).reshape(-1, 3)
    return capture.cameras[camera].screen_from_world(points)[:, :2].reshape(2, -1, 2)


def test_they_go_through_lens_size_and_window_as_images_do(with_lens):
    scene, root = with_lens
    capture = open_capture(root)
    rounding = 2.0**-4  # of the file, and the lens stretches it a little
    for shown in (capture, capture.resized(0.5), capture.cropped({"B": (20, 30, 150, 240)}).resized(2.0)):
        for camera in scene.cameras:
            found = shown.keypoints(camera)
            assert found.names == JOINTS and found.frames.tolist() == [0, 1] and (found.confidence == 0.5).all()
            scale = shown.windows[camera].scale[0]
            np.testing.assert_allclose(found.points, projected(shown, scene, camera), atol=rounding * scale)


def test_the_lens_is_undone_exactly():
    lens = Distortion.from_opencv(LENS, subject="")
    assert lens is not None
    plane = np.random.default_rng(1).uniform(-0.55, 0.55, (200, 2))
    np.testing.assert_allclose(lens.undistort(lens.distort(plane)), plane, atol=1e-12)


def test_what_is_left_out_is_left_out(with_lens):
    capture = open_capture(with_lens[1])
    fewer = capture.without([Problem("", "A", 0), Problem("", "C")])
    assert fewer.keypoints("A").frames.tolist() == [1] and fewer.keypoints("B").frames.tolist() == [0, 1]
    assert capture.without([Problem("", None, 1)]).keypoints("B").frames.tolist() == [0]
    with pytest.raises(InputError, match="one of A, B"):
        fewer.keypoints("C")


def test_without_any_there_are_none(tmp_path):
    scene = make_scene(lens=LENS)
    capture = open_capture(write_simple(scene, tmp_path / "capture"))
    assert capture.keypoints("A") is None
    with pytest.raises(InputError, match="folder of keypoints"):
        open_capture(capture.root, keypoints=tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"such as A\.npz"):
        open_capture(capture.root, keypoints=tmp_path / "empty")


def test_keypoints_of_a_tool_take_the_place_of_the_captures_own(with_lens, tmp_path):
    scene, root = with_lens
    people = [{"pose_keypoints_2d": [50.0, 60.0, 0.9] * 25, "person_id": [person]} for person in (1, 2)]
    people[1]["pose_keypoints_2d"] = [70.0, 80.0, 0.8] * 25
    (tmp_path / "openpose" / "B").mkdir(parents=True)
    (tmp_path / "openpose" / "B" / "000001_keypoints.json").write_text(json.dumps({"people": people}))
    capture = open_capture(root, keypoints=tmp_path / "openpose")
    assert capture.keypoints("A") is None and capture.keypoints("B").frames.tolist() == [1]
    K, lens = scene.cameras["B"].K, Distortion.from_opencv(LENS, subject="")
    assert lens is not None

    def bent(found: Keypoints2D) -> np.ndarray:
        return K[:2, :2] @ lens.distort((found.points[0, :1] - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T)[0] + K[:2, 2]

    np.testing.assert_allclose(bent(capture.keypoints("B")), [50.5, 60.5], atol=1e-9)
    other = open_capture(root, keypoints=tmp_path / "openpose", person=2)
    np.testing.assert_allclose(bent(other.keypoints("B")), [70.5, 80.5], atol=1e-9)


def test_easymocap_has_them_beside_its_images(tmp_path):
    scene = make_scene(lens=LENS)
    root = write_easymocap(scene, tmp_path / "capture")
    points = on_disk(scene, "B")
    for frame in range(2):
        # Its pixel centres are at whole numbers. BODY_25: 4 is the right wrist, 7 the left one.
        body = np.zeros((25, 3))
        body[7, :2], body[4, :2] = points[frame, 1] - 0.5, points[frame, 2] - 0.5
        body[[4, 7], 2] = 0.9
        path = root / "annots" / "B" / f"{frame:06d}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"annots": [{"personID": 0, "bbox": [0, 0, 1, 1, 1], "keypoints": body.tolist()}]}))
    capture = open_capture(root)
    found = capture.keypoints("B").select(("coco_left_wrist", "coco_right_wrist", "nose"), (0, 1))
    np.testing.assert_allclose(found.points[:, :2], projected(capture, scene, "B")[:, 1:3], atol=1e-3)
    assert (found.confidence == [0.9, 0.9, 0.0]).all()


def test_a_damaged_file_is_a_problem_and_its_images_are_kept(with_lens):
    root = with_lens[1]
    (root / "keypoints" / "B.npz").write_bytes(b"no archive")
    capture = open_capture(root)
    problems = find_problems(capture, decode=False)
    assert len(problems) == 1 and "B.npz" in problems[0].message
    assert "B" in capture.without(problems).cameras


def test_a_conversion_takes_them_along(with_lens, tmp_path):
    scene, root = with_lens
    assert main(["capture", "convert", str(root), "--out", str(tmp_path / "new"), "--scale", "0.5", "--json"]) == 0
    capture = open_capture(tmp_path / "new")
    assert not capture.recording.distortions
    for camera in scene.cameras:
        np.testing.assert_allclose(capture.keypoints(camera).points, projected(capture, scene, camera), atol=0.1)


def test_the_command_writes_our_layout(with_lens, tmp_path, capsys):
    root = with_lens[1]
    points = np.full((1, 33, 4), 0.25)
    (tmp_path / "mediapipe").mkdir()
    np.savez(tmp_path / "mediapipe" / "A.npz", pose=points)
    command = ["keypoints", "convert", str(tmp_path / "mediapipe"), "--out", str(tmp_path / "out"), "--json"]
    assert main(command) == 2 and "--size" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert main([*command, "--capture", str(root)]) == 0
    assert json.loads(capsys.readouterr().out)["cameras"]["A"]["points"] == 21
    found = open_capture(root, keypoints=tmp_path / "out").recording.keypoints.read("A")
    np.testing.assert_allclose(found.points[0, 0], [192 / 4, 256 / 4])
    assert main([*command[:-1], "--size", "192x"]) == 2
