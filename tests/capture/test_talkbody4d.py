"""TalkBody4D's traits: images already on black, mattes in `mattings/`, a world with y down, 100 betas, v_shape."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from smplxpp.body import load_body
from smplxpp.capture import detect_format, find_problems, open_capture
from smplxpp.core import InputError, matrix_from_rotvec
from tests.capture.scene import make_scene
from tests.capture.writers import write_talkbody4d


@pytest.fixture
def scene():
    return make_scene(lens=(0.0, 0.0, 0.0, 0.0, 0.0))


@pytest.fixture
def root(scene, tmp_path):
    return write_talkbody4d(scene, tmp_path / "set")


def describe(root, **content) -> None:
    (root / "capture.json").write_text(json.dumps({"format": "talkbody4d"} | content))


def test_images_that_are_on_black_are_not_multiplied_by_their_mattes_again(root):
    capture = open_capture(root)
    assert capture.recording.background == (0.0, 0.0, 0.0)
    camera = next(iter(capture.cameras))
    colour, opacity = capture.foreground(camera, 0)
    edge = (opacity > 40) & (opacity < 215)
    assert edge.sum() > 100
    np.testing.assert_array_equal(colour, capture.image(camera, 0))
    # Multiplied twice, edges would be darker by their opacity.
    expected = opacity[edge, None] / 255.0 * colour[opacity == 255].mean(axis=0)
    assert np.abs(colour[edge].mean(axis=0) - expected.mean(axis=0)).max() < 4


def test_photographs_are_refused_until_they_are_declared(root, scene):
    for (name, frame), image in scene.photographs.items():
        Image.fromarray(image).save(root / "images" / name / f"{frame:06d}.jpg", quality=98)
    with pytest.raises(InputError, match=r"composited on RGB \[0, 0, 0\].*outside the mask"):
        open_capture(root).composited("A", 0)
    describe(root, background=None)
    assert detect_format(root) == "talkbody4d"
    capture = open_capture(root)
    assert capture.recording.background is None
    assert find_problems(capture) == []
    assert capture.composited(next(iter(capture.cameras)), 0).max() > 0.3
    describe(root, background=[1, 1, 1])
    with pytest.raises(InputError, match=r"background in capture\.json"):
        open_capture(root)


def test_mattes_are_found_and_never_taken_for_the_images(root):
    assert all(open_capture(root).presence("mask").ravel())
    (root / "mattings").rename(root / "masks")
    assert all(open_capture(root).presence("mask").ravel())
    shutil.rmtree(root / "images")
    with pytest.raises(InputError, match=r"folder with folders of images.*masks \(mattes\)"):
        open_capture(root)
    shutil.copytree(root / "masks", root / "frames")
    assert open_capture(root).file("A", 0) == root / "frames" / "A" / "000000.png"
    shutil.rmtree(root / "masks")
    assert any(problem.message.startswith("no masks") for problem in find_problems(open_capture(root)))


def test_turning_the_world_moves_no_pixel(root, scene):
    """The authors' projection, K (R (R(Rh) X + Th) + T), against the capture's cameras and parameters."""
    capture, body = open_capture(root), load_body()
    calibration = json.loads((root / "calibration.json").read_text())
    record = {k: np.array(v) for k, v in json.loads((root / "smplx" / "000001.json").read_text()).items()}
    inner = {name: value for name, value in record.items() if name not in ("Rh", "Th")}
    import torch

    X = body.forward({k: torch.tensor(v) for k, v in inner.items()}, flat_hand_mean=True).vertices[0].numpy()
    world = X @ matrix_from_rotvec(record["Rh"][0]).T + record["Th"][0]
    turned = body.forward(capture.params(1)).vertices[0]
    assert turned[:, 1].argmax() == world[:, 1].argmin(), "the head's top"
    for name, camera in capture.cameras.items():
        pose = next(v for k, v in calibration["camera_poses"].items() if k.split("_to_")[0] == name)
        pixels = []
        for points, K, R, T in (
            (world, calibration["cameras"][name]["K"], pose["R"], pose["T"]),
            (turned, camera.K, camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]),
        ):
            seen = (points @ np.array(R).T + np.array(T)) @ np.array(K).T
            pixels.append(seen[:, :2] / seen[:, 2:])
        np.testing.assert_allclose(pixels[1] - 0.5, pixels[0], atol=1e-9)


def test_a_world_that_has_y_up_already_is_told_and_can_be_said(root):
    path = root / "calibration.json"
    content = json.loads(path.read_text())
    for pose in content["camera_poses"].values():
        pose["R"] = (np.array(pose["R"]) @ np.diag([1.0, -1, -1])).tolist()
    path.write_text(json.dumps(content))
    assert any("point along -y of the world" in problem.message for problem in find_problems(open_capture(root)))
    describe(root, up="y")
    capture = open_capture(root)
    assert find_problems(capture) == []
    assert capture.params(0).transl[0, 1] < 0, "parameters follow: these have y down"
    describe(root, up="z")
    with pytest.raises(InputError, match=r"up in capture\.json"):
        open_capture(root)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("betas", [[0.1] * 100], "the open body, taken because none is given, has 20 betas, not 100"),
        ("v_shape", [[[0.0, 0.0, 0.0]] * 7], "vertices, where v_shape has 7"),
        ("expression", [[0.1] * 100], "52 expressions, not 100"),
    ],
)
def test_without_their_body_parameters_are_left_out_once_and_frames_stay(root, key, value, message):
    for path in (root / "smplx").iterdir():
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    capture = open_capture(root)
    problems = find_problems(capture)
    assert len(problems) == 1 and message in problems[0].message and "--body" in problems[0].message
    rest = capture.without(problems)
    assert rest.frames == capture.frames == (0, 1) and len(rest.views()) == 6
    assert capture.params(0) is None
    given = open_capture(root, body=load_body(num_betas=5))
    assert "the body given has" in given.problems[0].message


def test_a_damaged_first_file_of_parameters_spoils_its_frame_alone(root):
    (root / "smplx" / "000000.json").write_text("{")
    capture = open_capture(root)
    assert capture.params(1) is not None
    assert [problem.frame for problem in find_problems(capture)] == [0]
