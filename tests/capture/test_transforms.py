"""transforms.json as Instant-NGP, nerfstudio, Blender, D-NeRF and NeuS2 write it, and as nobody should."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from smplxpp.capture import find_problems, open_capture
from smplxpp.capture.distortion import FISHEYE, Distortion
from smplxpp.core.errors import InputError

SIZE = {"w": 8, "h": 6}
SPACE = {**SIZE, "fl_x": 9.0}


def pose(k: float = 0.0) -> list[list[float]]:
    """Camera to world, moved along x by k."""
    matrix = np.eye(4)
    matrix[0, 3] = k
    return matrix.tolist()


def picture(path, *, size=(8, 6), mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, (200, 100, 50, 128)[: len(mode)]).save(path)


def scene(root, content, names, *, file="transforms.json", still=False, images=True):
    """A file that names images, each with another pose unless `still`; each image of 8 x 6 pixels."""
    content = dict(content)
    content["frames"] = [
        entry if isinstance(entry, dict) else {"file_path": entry, "transform_matrix": pose(0 if still else k)}
        for k, entry in enumerate(names)
    ]
    (root / file).parent.mkdir(parents=True, exist_ok=True)
    (root / file).write_text(json.dumps(content))
    for entry in content["frames"] if images else ():
        picture((root / file).parent / entry["file_path"].replace("\\", "/"))
    return root


def only(capture):
    (camera,) = capture.cameras.values()
    return camera


def frame(name="a.png", **values):
    return {"file_path": name, "transform_matrix": pose(), **values}


def test_a_fisheye_is_a_fisheye_whoever_says_so(tmp_path):
    k = {"k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0.001}
    expected = Distortion.from_opencv([0.03, -0.01, 0.002, 0.001], subject="", model=FISHEYE)
    for name, words in (
        ("nerfstudio", {"camera_model": "OPENCV_FISHEYE", **k}),
        ("instant-ngp", {"is_fisheye": True, "p1": 0.0, "p2": 0.0, **k}),
        ("list", {"camera_model": "OPENCV_FISHEYE", "distortion_params": [*k.values(), 0.0, 0.0], "k1": 9.0}),
    ):
        capture = open_capture(scene(tmp_path / name, SPACE | words, ["a.png"]))
        assert capture.recording.distortions == {"a": expected}
    mixed = [frame("a.png", camera_model="OPENCV_FISHEYE", **k), frame("b.png", camera_model="PINHOLE")]
    capture = open_capture(scene(tmp_path / "mixed", SPACE | {"camera_model": "OPENCV"}, mixed))
    assert capture.recording.distortions == {"a": expected}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ({"equirectangular": True}, "received equirectangular"),
        ({"latlong": 1}, "received latlong"),
        ({"orthographic": True}, "received orthographic"),
        ({"ftheta_p0": 0.0}, "received ftheta_p0"),
        ({"camera_model": "EQUIRECTANGULAR"}, "received EQUIRECTANGULAR"),
        ({"camera_model": "ORTHOPHOTO"}, "received ORTHOPHOTO"),
        ({"camera_model": "FISHEYE624"}, "received FISHEYE624"),
        ({"camera_model": "PINHOLE", "is_fisheye": True}, "PINHOLE with is_fisheye"),
        ({"is_fisheye": True, "p1": 0.1}, "p1 and p2 of a fisheye"),
        ({"camera_model": "OPENCV", "k4": 0.1}, "k4, k5 or k6"),
    ],
)
def test_other_projections_are_refused_with_the_remedy(tmp_path, words, told):
    with pytest.raises(InputError, match=rf"a\.png.*{told}.*undistort"):
        open_capture(scene(tmp_path, SPACE | words, ["a.png"]))


def test_a_rolling_shutter_that_matters_is_refused(tmp_path):
    ends = {"transform_matrix_start": pose(1), "transform_matrix_end": pose(1)}
    capture = open_capture(scene(tmp_path / "a", SPACE | {"rolling_shutter": [0, 0, 1, 0]}, [frame(**ends)]))
    assert only(capture).position[0] == 1
    with pytest.raises(InputError, match="stands still while it exposes"):
        open_capture(scene(tmp_path / "b", SPACE, [frame(**ends | {"transform_matrix_end": pose(2)})]))


@pytest.mark.parametrize(
    ("words", "fx", "fy"),
    [
        ({"fl_x": 9.0}, 9.0, 9.0),
        ({"fl_x": 9.0, "fl_y": 7.0}, 9.0, 7.0),
        ({"fl_y": 7.0}, 7.0, 7.0),
        ({"camera_angle_x": np.pi / 2}, 4.0, 4.0),
        ({"camera_angle_x": np.pi / 2, "camera_angle_y": 2 * np.arctan(0.3)}, 4.0, 10.0),
        ({"x_fov": 90.0, "fl_x": 9.0}, 4.0, 4.0),
        ({"y_fov": 90.0}, 3.0, 3.0),
        ({"intrinsic_matrix": [[5, 0, 4, 0], [0, 6, 3, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "fl_x": 9.0}, 5.0, 6.0),
    ],
)
def test_focal_lengths_in_all_the_ways_to_say_them(tmp_path, words, fx, fy):
    K = only(open_capture(scene(tmp_path, SIZE | words, ["a.png"]))).K
    np.testing.assert_allclose(K, [[fx, 0, 4], [0, fy, 3], [0, 0, 1]], atol=1e-12)


def test_what_a_frame_says_goes_before_what_the_file_says(tmp_path):
    """Instant-NGP: a frame's focal length replaces both of the file's."""
    own = frame(fl_x=20.0, cx=1.5, k1=0.1)
    capture = open_capture(scene(tmp_path, SPACE | {"fl_y": 7.0, "cx": 4.0, "cy": 2.5, "k1": 0.0}, [own]))
    np.testing.assert_array_equal(only(capture).K, [[20, 0, 1.5], [0, 20, 2.5], [0, 0, 1]])
    assert capture.recording.distortions["a"].radial[0] == 0.1


@pytest.mark.parametrize("scale", [1 / 844.4, 1.00002, 30.0])
def test_a_scaled_rotation_is_the_rotation(tmp_path, scale):
    """Tools that scale a scene by its matrices scale the cameras' axes with it; a mirrored one is still refused."""
    angle = np.deg2rad(30)
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = 3.0, -2.0, 5.0
    plain = only(open_capture(scene(tmp_path / "plain", SPACE, [frame(transform_matrix=matrix.tolist())])))
    scaled = matrix.copy()
    scaled[:3, :3] *= scale
    found = only(open_capture(scene(tmp_path / "scaled", SPACE, [frame(transform_matrix=scaled.tolist())])))
    np.testing.assert_allclose(found.cam_from_world, plain.cam_from_world, atol=1e-12)
    np.testing.assert_allclose(found.position, matrix[:3, 3], atol=1e-12)
    scaled[:3, 0] *= -1
    with pytest.raises(InputError, match="a rotation matrix"):
        open_capture(scene(tmp_path / "mirrored", SPACE, [frame(transform_matrix=scaled.tolist())]))


def test_a_size_that_is_not_said_is_the_images(tmp_path):
    scene(tmp_path, {"camera_angle_x": np.pi / 2}, ["a.png", "gone.png", "broken.png"])
    (tmp_path / "gone.png").unlink()
    (tmp_path / "broken.png").write_bytes(b"no image")
    capture = open_capture(tmp_path)
    camera = only(capture)
    assert (camera.width, camera.height, camera.K[0, 0]) == (8, 6, pytest.approx(4.0))
    assert [name for name in ("gone", "broken") if any(name in p.message for p in capture.problems)] == [
        "gone",
        "broken",
    ]


def test_names_are_the_paths_where_stems_are_alike(tmp_path):
    """Blender's scenes: `train/r_0` and `test/r_0` were one camera, or an error."""
    for part in ("train", "val", "test"):
        names = [f"./{part}/r_0", f"./{part}/r_1"]
        content = SPACE | {"camera_angle_x": 0.6}
        frames = [frame(name) | {"transform_matrix": pose(k)} for k, name in enumerate(names)]
        scene(tmp_path, content, frames, file=f"transforms_{part}.json", images=False)
        for name in names:
            picture(tmp_path / f"{name}.png", mode="RGBA")
    capture = open_capture(tmp_path)
    assert sorted(capture.cameras) == ["test_r_0", "test_r_1", "train_r_0", "train_r_1", "val_r_0", "val_r_1"]
    assert capture.frames == (0,) and not capture.problems
    assert capture.splits.train_cameras == ("train_r_0", "train_r_1")
    assert sorted(capture.splits.novel_view_cameras) == ["test_r_0", "test_r_1", "val_r_0", "val_r_1"]
    assert capture.mask("val_r_1", 0).max() == 128


def test_folders_of_numbered_images_are_cameras_and_numbers_are_frames(tmp_path):
    names = [f"{camera}/{n:06d}.jpg" for camera in ("cam_a", "cam_b") for n in (0, 7)]
    frames = [frame(name) | {"transform_matrix": pose("b/" in name)} for name in names]
    capture = open_capture(scene(tmp_path / "film", SPACE, frames))
    assert list(capture.cameras) == ["cam_a", "cam_b"] and capture.frames == (0, 7)
    assert capture.file("cam_b", 7).name == "000007.jpg"
    still = open_capture(scene(tmp_path / "moment", SPACE, ["images/cam_a/000005.jpg", "images/cam_b/000005.jpg"]))
    assert list(still.cameras) == ["cam_a", "cam_b"] and still.frames == (5,)
    flat = [frame(f"images/{c}_f{n}.png") | {"transform_matrix": pose(c == "b")} for c in "ab" for n in (1, 2)]
    capture = open_capture(scene(tmp_path / "flat", SPACE, flat))
    assert list(capture.cameras) == ["a_f", "b_f"] and capture.frames == (1, 2)


def test_a_camera_that_moves_among_still_ones_keeps_its_time(tmp_path):
    frames = [frame(f"still/{n}.png") for n in (3, 4)]
    frames += [frame(f"hand/{n}.png") | {"transform_matrix": pose(n)} for n in (3, 4)]
    capture = open_capture(scene(tmp_path, SPACE, frames))
    assert list(capture.cameras) == ["still", "hand_3", "hand_4"] and capture.frames == (3, 4)
    assert capture.file("hand_4", 4) is not None and capture.file("hand_4", 3) is None


def test_a_walk_around_a_still_scene_is_one_camera_an_image(tmp_path):
    capture = open_capture(scene(tmp_path, SPACE, [f"images/{n:04d}.jpg" for n in (1, 2, 9)]))
    assert list(capture.cameras) == ["0001", "0002", "0009"] and capture.frames == (0,)


def test_images_that_differ_by_folder_or_suffix_alone(tmp_path):
    names = ["images/1a.png", "images_2/1a.png"]
    assert list(open_capture(scene(tmp_path / "a", SPACE, names)).cameras) == ["images_1a", "images_2_1a"]
    names = ["images/1a.png", "images/1a.jpg"]
    assert list(open_capture(scene(tmp_path / "b", SPACE, names)).cameras) == ["images_1a.png", "images_1a.jpg"]


def test_time_orders_frames(tmp_path):
    """D-NeRF: a moving camera and `time`, from 0 to 1."""
    frames = [frame(f"./train/r_{k:03d}") | {"time": t, "transform_matrix": pose(k)} for k, t in enumerate((0, 1, 0.5))]
    capture = open_capture(scene(tmp_path, SPACE, frames, file="transforms_train.json", images=False))
    assert [p.frame for p in capture.problems] == [0, 2, 1] and list(capture.cameras)[2] == "train_r_002"


@pytest.mark.parametrize(
    ("pattern", "camera"),
    [
        ("images/{f:06d}/image_c_{c:03d}_f_{f:06d}.png", "image_c_{c:03d}"),
        ("images/{c:02d}/{f:06d}.png", "{c:02d}"),
        ("{f:04d}/{c:03d}.png", "{c:03d}"),
        ("rgb/leaf{c}_{f}.png", "leaf{c}"),
    ],
)
def test_numbered_files_name_frames_and_images_name_cameras(tmp_path, pattern, camera):
    """Cameras and frames of the same numbers, so that a path may hold a frame's number twice."""
    for f in (0, 1, 2):
        frames = [frame(pattern.format(c=c, f=f)) | {"transform_matrix": pose(c)} for c in (0, 1, 2)]
        scene(tmp_path, SPACE | {"from_na": True}, frames, file=f"transform_{f:06d}.json")
    capture = open_capture(tmp_path)
    assert list(capture.cameras) == [camera.format(c=c) for c in (0, 1, 2)] and capture.frames == (0, 1, 2)
    assert not [p for p in find_problems(capture) if p.camera is not None or p.frame is not None]
    assert [c.position[0] for c in capture.cameras.values()] == [0, 1, 2]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPG", ".webp"])
def test_suffixes_may_be_missing_and_slashes_bent(tmp_path, suffix):
    scene(tmp_path, SPACE, ["images\\r_0.5"], images=False)
    picture(tmp_path / f"images/r_0.5{suffix}")
    capture = open_capture(tmp_path)
    if suffix == ".JPG":
        assert capture.problems  # another case is another file
    else:
        assert capture.file(only(capture).name, 0).suffix == suffix and not capture.problems


def test_masks_beside_and_by_name(tmp_path):
    for k, (name, words) in enumerate(
        (
            ("masks/a.png", {"mask_path": "masks/a.png"}),
            ("a.png.alpha.png", {}),
            ("a.alpha.png", {}),
        )
    ):
        root = scene(tmp_path / str(k), SPACE, [frame("a.png", **words), frame("b.png")])
        picture(root / name, mode="L")
        capture = open_capture(root)
        assert capture.mask("a", 0).max() == 200 and capture.file("b", 0, "mask") is None
    (root / "a.alpha.png").unlink()
    picture(root / "dynamic_mask_b.png", mode="L")
    assert any("dynamic_mask_*.png: left aside" in p.message for p in open_capture(root).problems)


def test_lists_of_nerfstudio_split(tmp_path):
    lists = {"train_filenames": ["images/a.png"], "val_filenames": ["./images/b.png"], "test_filenames": []}
    capture = open_capture(scene(tmp_path, SPACE | lists, [f"images/{n}.png" for n in "abc"]))
    assert capture.splits.train_cameras == ("a",) and capture.splits.novel_view_cameras == ("b",)


def test_an_applied_scale_is_said(tmp_path):
    capture = open_capture(scene(tmp_path, SPACE | {"applied_scale": 0.3}, ["a.png"]))
    assert [p.message.endswith("left aside") for p in capture.problems] == [True]
    assert not open_capture(scene(tmp_path, SPACE | {"applied_scale": 1.0}, ["a.png"])).problems


@pytest.mark.parametrize("name", ["../../secret.png", "/etc/secret.png", "..\\..\\x.png", "", "a\0.png", "x" * 5000])
def test_images_outside_of_the_folder_are_refused(tmp_path, name):
    for entry in (frame(name), frame("a.png", mask_path=name)):
        root = scene(tmp_path / "set", SPACE, [entry], images=False)
        picture(root / "a.png")
        with pytest.raises(InputError):
            open_capture(root)
        shutil.rmtree(root)


HOSTILE = [None, True, "x", [], {}, -1, 0, 10**400, 1e308, float("nan"), [[1]], "9" * 5000]


@pytest.mark.parametrize(
    "key",
    ["w", "fl_x", "cx", "k1", "camera_model", "intrinsic_matrix", "transform_matrix", "file_path", "mask_path", "time"]
    + ["distortion_params", "applied_scale", "train_filenames", "frames", "is_fisheye", "x_fov", "frame"],
)
def test_any_value_is_read_or_refused(tmp_path, key):
    root = scene(tmp_path, SPACE | {"h": 6}, ["a.png", "b.png"])
    content = json.loads((root / "transforms.json").read_text())
    for value in HOSTILE:
        changed = json.loads(json.dumps(content))
        if key == "frame":
            changed["frames"][0] = value
        elif key in ("transform_matrix", "file_path", "mask_path", "time"):
            changed["frames"][0][key] = value
        else:
            changed[key] = value
        (root / "transforms.json").write_text(json.dumps(changed))
        try:
            assert open_capture(root).cameras
        except InputError:
            pass


def test_numbers_of_thirty_digits(tmp_path):
    with pytest.raises(InputError, match="at most 18 digits"):
        open_capture(scene(tmp_path / "a", SPACE, ["a.png"], file=f"transform_{'9' * 30}.json"))
    capture = open_capture(scene(tmp_path / "b", SPACE, [f"cam_{c}/{'9' * 30}.png" for c in "ab"]))
    assert len(capture.cameras) == 2 and capture.frames == (0,)


def test_the_same_image_in_two_files_has_one_pose(tmp_path):
    scene(tmp_path, SPACE, ["a.png"])
    scene(tmp_path, SPACE, ["a.png"], file="transforms_train.json")
    assert list(open_capture(tmp_path).cameras) == ["a"]
    scene(tmp_path, SPACE, [frame("a.png", transform_matrix=pose(3))], file="transforms_train.json")
    with pytest.raises(InputError, match="moving cameras"):
        open_capture(tmp_path)
