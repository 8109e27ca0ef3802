"""Bad input is reported with file names, and the run goes on without it."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from smplxpp.capture import find_problems, open_capture
from smplxpp.core.errors import InputError
from tests.capture.scene import make_scene
from tests.capture.writers import (
    write_4ddress,
    write_actorshq,
    write_avatarrex,
    write_easymocap,
    write_neus2,
    write_simple,
)


@pytest.fixture
def rig(tmp_path):
    return write_simple(make_scene(), tmp_path / "rig")


def messages(root, **options) -> list[str]:
    return [problem.message for problem in find_problems(open_capture(root), **options)]


def test_a_sound_capture_has_no_problems(rig):
    assert messages(rig) == []


def test_a_truncated_image_is_named_and_left_out(rig):
    path = rig / "rgbs/B/B_rgb000001.jpg"
    path.write_bytes(path.read_bytes()[:-400])
    capture = open_capture(rig)
    with pytest.raises(InputError, match=r"B_rgb000001\.jpg.*whole image.*truncated"):
        capture.image("B", 1)
    problems = find_problems(capture)
    assert [(p.camera, p.frame) for p in problems] == [("B", 1)] and "B_rgb000001.jpg" in problems[0].message
    assert messages(rig, decode=False) == []
    rest = capture.without(problems)
    assert len(rest.views()) == 5 and ("B", 1) not in rest.views()
    assert all(rest.composited(*view).shape == (256, 192, 3) for view in rest.views())
    assert find_problems(rest) == []


def test_a_camera_missing_from_the_calibration_and_one_without_images(rig):
    content = json.loads((rig / "cameras.json").read_text())
    content["cameras"][0]["name"] = "Z"
    (rig / "cameras.json").write_text(json.dumps(content))
    found = messages(rig)
    assert any("rgbs/A" in m and "not calibrated" in m for m in found)
    assert any(m.startswith("camera Z: calibrated, but without any image") for m in found)
    assert open_capture(rig).views(["Z"]) == []


def test_a_mask_of_another_size_names_both_sizes(rig):
    path = rig / "masks/A/A_mask000000.png"
    Image.open(path).resize((96, 128)).save(path)
    with pytest.raises(InputError, match=r"A_mask000000\.png.*192 x 256.*96 x 128"):
        open_capture(rig).mask("A", 0)
    assert any("A_mask000000.png" in m for m in messages(rig))


def test_images_of_another_size_than_the_calibration(rig):
    for path in (rig / "rgbs/C").iterdir():
        Image.open(path).resize((384, 512)).save(path)
    assert sum("the size of camera C" in m for m in messages(rig)) == 2


def test_nan_in_one_frame_spoils_that_frame_alone(tmp_path):
    root = write_avatarrex(make_scene(), tmp_path / "subject")
    arrays = dict(np.load(root / "smpl_params.npz"))
    arrays["body_pose"][1, 5] = np.nan
    np.savez(root / "smpl_params.npz", **arrays)
    capture = open_capture(root)
    assert np.isfinite(capture.params(0).body_pose).all()
    with pytest.raises(InputError, match=r"smpl_params\.npz: row 1.*NaN"):
        capture.params(1)
    problems = find_problems(capture)
    assert [(p.camera, p.frame) for p in problems] == [(None, 1)]
    assert capture.without(problems).frames == (0,)


def test_a_row_of_nothing_but_nan_is_a_frame_without_parameters(tmp_path):
    """As registration and refinement write frames that they were not asked for."""
    root = write_avatarrex(make_scene(), tmp_path / "subject")
    arrays = dict(np.load(root / "smpl_params.npz"))
    stacked = {name: array for name, array in arrays.items() if array.ndim == 2 and len(array) == 2}
    assert "body_pose" in stacked
    for array in stacked.values():
        array[1] = np.nan
    np.savez(root / "smpl_params.npz", **arrays)
    capture = open_capture(root)
    assert np.isfinite(capture.params(0).body_pose).all() and capture.params(1) is None
    assert capture.recording.params.frames().tolist() == [0]
    assert [problem.message for problem in find_problems(capture)] == ["frame 1: no body parameters"]


def test_nan_in_a_frames_own_file(rig):
    path = rig / "params/000001.npz"
    arrays = dict(np.load(path))
    arrays["transl"][:] = np.inf
    np.savez(path, **arrays)
    assert any("000001.npz" in m and "finite" in m for m in messages(rig))
    assert len(open_capture(rig).params(0)) == 1


def test_a_file_that_is_all_nan(tmp_path):
    root = write_avatarrex(make_scene(), tmp_path / "subject")
    arrays = dict(np.load(root / "smpl_params.npz"))
    np.savez(root / "smpl_params.npz", **{**arrays, "transl": arrays["transl"] * np.nan})
    assert any("every row" in m for m in messages(root))


def test_a_frame_in_one_camera_only_and_gaps(rig):
    for name in ("A", "B"):
        (rig / f"rgbs/{name}/{name}_rgb000001.jpg").unlink()
    assert any("frame 1: an image in camera C alone" in m for m in messages(rig))
    (rig / "rgbs/C/C_rgb000000.jpg").unlink()
    assert any("camera C: no image of frame 0" in m for m in messages(rig))


def test_missing_masks_and_parameters(rig):
    (rig / "masks/A/A_mask000001.png").unlink()
    (rig / "params/000001.npz").unlink()
    found = messages(rig, decode=False)
    assert any("A_rgb000001.jpg: no mask" in m for m in found)
    assert "frame 1: no body parameters" in found
    for path in rig.glob("masks/*/*"):
        path.unlink()
    assert any(m.startswith("no masks:") for m in messages(rig, decode=False))


def test_images_that_are_not_on_the_declared_background(rig):
    (rig / "capture.json").write_text("{}")
    assert sum("composited on RGB [0, 0, 0]" in m for m in messages(rig)) == 6


def test_label_maps_in_colours_and_of_another_size(rig):
    (rig / "labels/A").mkdir(parents=True)
    Image.new("RGB", (192, 256)).save(rig / "labels/A/A_label000000.png")
    np.save(rig / "labels/A/A_label000001.npy", np.zeros((5, 5), int))
    found = messages(rig)
    assert any("A_label000000.png" in m and "mode RGB" in m for m in found)
    assert any("A_label000001.npy" in m and "5 x 5" in m for m in found)


def test_images_named_in_a_transform_file_but_missing(tmp_path):
    root = write_neus2(make_scene(), tmp_path / "scene")
    (root / "images/000001/image_c_002_f_000001.png").unlink()
    capture = open_capture(root)
    assert ["image_c_002_f_000001.png" in p.message for p in capture.problems] == [True]
    assert capture.presence().sum() == 5


@pytest.mark.parametrize(
    ("write", "file", "old", "new", "words"),
    [
        (write_simple, "cameras.json", '"h": 256', '"h": 0', "image size"),
        (write_simple, "cameras.json", '"R": [[', '"R": [[7, ', "R: expected finite numbers"),
        (write_simple, "cameras.json", '"dist"', '"dust"', None),
        (write_avatarrex, "calibration_full.json", '"imgSize"', '"size"', "entry 'imgSize'"),
        (write_avatarrex, "calibration_full.json", '"distCoeff": [0.0', '"distCoeff": [0.0, 1.0', "4, 5 or 8"),
        (write_neus2, "train/transform_000000.json", "transform_matrix", "matrix", "entry 'transform_matrix'"),
        (write_neus2, "train/transform_000000.json", '"from_na": true', '"from_na": ', "JSON"),
        (write_easymocap, "intri.yml", "rows: 3", "rows: 4", "intri.yml: K_A"),
        (write_easymocap, "extri.yml", "T_B", "TB", "entry 'T_B'"),
    ],
)
def test_broken_calibrations_are_refused_with_the_files_name(tmp_path, write, file, old, new, words):
    root = write(make_scene(lens=(0.0,) * 5 if write is write_easymocap else None), tmp_path / "set")
    text = (root / file).read_bytes().decode()
    (root / file).write_bytes(text.replace(old, new, 1).encode())
    if words is None:
        assert open_capture(root).cameras
        return
    with pytest.raises(InputError, match=words):
        open_capture(root)


def test_a_rotation_that_is_none_is_refused(rig):
    content = json.loads((rig / "cameras.json").read_text())
    content["cameras"][1]["R"][0][0] *= -1
    (rig / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="camera 'B': R: expected a rotation matrix"):
        open_capture(rig)


def test_a_camera_that_moves_between_frames_is_refused(tmp_path):
    root = write_neus2(make_scene(), tmp_path / "scene")
    path = root / "train/transform_000001.json"
    content = json.loads(path.read_text())
    content["frames"][0]["transform_matrix"][0][3] += 0.01
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"transform_000001\.json.*image_c_000"):
        open_capture(root)


def test_several_scales_of_actorshq_have_to_be_chosen_from(tmp_path):
    root = write_actorshq(make_scene(), tmp_path / "hq")
    (root / "2x" / "rgbs").mkdir(parents=True)
    (root / "2x" / "calibration.csv").write_text("name\n")
    with pytest.raises(InputError, match="2x, 4x"):
        open_capture(root)
    assert open_capture(root / "4x").frames == (0, 1)


def test_cameras_of_4ddress_that_were_not_released_are_left_out(tmp_path):
    root = write_4ddress(make_scene(), tmp_path / "set")
    shutil.rmtree(root / "Capture" / "B")
    capture = open_capture(root)
    assert list(capture.cameras) == ["A", "C"] and [p.camera for p in capture.problems] == ["B"]
    assert find_problems(capture.without(capture.problems)) == []


def test_a_folder_of_two_layouts_is_ambiguous(rig):
    (rig / "intri.yml").write_text("")
    (rig / "extri.yml").write_text("")
    with pytest.raises(InputError, match=r"simple and easymocap.*format"):
        open_capture(rig)
    assert open_capture(rig, format="simple").format == "simple"


@pytest.mark.parametrize(("turn", "seen"), [([0, 2, 1], "+z"), ([1, 0, 2], "+x")])
def test_a_world_with_another_axis_up_is_told(rig, turn, seen):
    content = json.loads((rig / "cameras.json").read_text())
    # A permutation of two axes, one of them negated, is a rotation.
    world = np.eye(3)[turn] * [[1], [1], [-1]] if seen == "+x" else np.eye(3)[turn] * [[1], [-1], [1]]
    for camera in content["cameras"]:
        camera["R"] = (np.array(camera["R"]) @ world).tolist()
    (rig / "cameras.json").write_text(json.dumps(content))
    sign = -np.mean([c.cam_from_world[1, :3] for c in open_capture(rig).cameras.values()], axis=0)
    expected = f"{'+' if sign['xyz'.index(seen[1])] > 0 else '-'}{seen[1]}"
    found = messages(rig, decode=False)
    assert len(found) == 1 and f"point along {expected} of the world, where +y is expected" in found[0]
    content["cameras"] = content["cameras"][:2]
    (rig / "cameras.json").write_text(json.dumps(content))
    assert not any("of the world" in message for message in messages(rig, decode=False))
