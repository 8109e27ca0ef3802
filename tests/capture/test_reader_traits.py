"""Traits of files that others write, for sets whose usual folders tests/capture/test_readers.py reads."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipelines.cli import main
from smplxpp.body import load_body
from smplxpp.capture import find_problems, open_capture
from smplxpp.capture.files import FileSeries, images_beside
from smplxpp.capture.readers.common import RigOptions
from smplxpp.capture.writers import save_params_by_row
from smplxpp.core.errors import InputError
from tests.capture.calibration_writers import pose2sim as write_calibration
from tests.capture.scene import make_scene
from tests.capture.test_calibrations import rig as make_rig
from tests.capture.writers import (
    write_actorshq,
    write_avatarrex,
    write_easymocap,
    write_talkbody4d,
    write_thuman4,
)

LENS = (0.02, -0.01, 0.001, -0.001, 0.0)


@pytest.mark.parametrize("place", ["beside the calibration", "beside the scales"])
def test_actorshq_fits_lie_beside_the_calibration_or_the_scales(tmp_path, place):
    root = write_actorshq(make_scene(), tmp_path / "set")
    if place == "beside the calibration":
        (root / "smpl_params.npz").rename(root / "4x" / "smpl_params.npz")
    for folder in (root, root / "4x"):
        assert open_capture(folder).params(1) is not None
        assert find_problems(open_capture(folder), decode=False) == []


def test_easymocap_leaves_out_a_camera_called_none(tmp_path):
    """As its FileStorage does, which once wrote the brackets of a list under this name."""
    root = write_easymocap(make_scene(lens=LENS), tmp_path / "set")
    path = root / "intri.yml"
    path.write_bytes(path.read_bytes().replace(b"names:\r\n", b'names:\r\n  - "none"\r\n'))
    capture = open_capture(root)
    assert list(capture.cameras) == ["A", "B", "C"]
    problems = find_problems(capture, decode=False)
    assert [problem.message for problem in problems] == ["camera none, which EasyMocap itself drops: left aside"]
    assert len(capture.without(problems).views()) == 6


def test_lenses_of_more_cameras_than_a_session_has(tmp_path):
    """A studio's intri.yml has 32 cameras, the extri.yml of a session 11."""
    root = write_easymocap(make_scene(lens=LENS), tmp_path / "set")
    path = root / "extri.yml"
    text = path.read_bytes().decode().replace("names:\r\n", 'names:\r\n  - "D"\r\n')
    path.write_bytes("".join(line for line in text.split("R_B:")[0]).encode() + text[text.index("R_C:") :].encode())
    for options in ({}, {"rig": RigOptions(calibration=root / "intri.yml", up="y")}):
        capture = open_capture(root, **options)
        assert list(capture.cameras) == ["A", "C"]
        assert any("without a pose in extri.yml" in p.message and "B" in p.message for p in capture.problems)
    path.write_text("%YAML:1.0\n---\n")
    with pytest.raises(InputError, match=r"extri.yml: expected the pose of a camera"):
        open_capture(root)


def test_images_of_all_cameras_in_one_folder(tmp_path):
    """Named as recorders export them: 007_0001_00001.jpg is camera 7, moment 1."""
    scene = make_scene(names=("7", "11", "31"), lens=LENS)
    root = write_easymocap(scene, tmp_path / "set")
    for path in sorted((root / "images").glob("*/*.jpg")):
        path.rename(root / "images" / f"{int(path.parent.name):03d}_0001_{int(path.stem):05d}.jpg")
        if not any(path.parent.iterdir()):
            path.parent.rmdir()
    capture = open_capture(root)
    assert list(capture.cameras) == ["7", "11", "31"] and len(capture.views()) == 6
    assert capture.file("7", 1).name == "007_0001_00001.jpg"
    as_rig = open_capture(root, rig=RigOptions(calibration=root / "intri.yml", up="y"))
    assert [(str(c), f) for c, f in as_rig.views()] == [(str(c), f) for c, f in capture.views()]
    # A picture that is no camera's makes it a folder of something else.
    (root / "images" / "plan.jpg").write_bytes((root / "images" / "007_0001_00000.jpg").read_bytes())
    assert images_beside(root / "images", ["7", "11", "31"]) == {}
    (root / "images" / "plan.jpg").rename(root / "images" / "7.jpg")
    assert images_beside(root / "images", ["7", "11", "31"]) == {}


@pytest.mark.parametrize("up", ["z", "-x"])
def test_a_world_that_stands_on_another_axis_is_turned_as_asked(tmp_path, up):
    """EasyMocap's boards have z up: `--up` was accepted and did nothing."""
    scene = make_scene(lens=LENS)
    root = write_easymocap(scene, tmp_path / "set")
    given, turned = open_capture(root), open_capture(root, rig=RigOptions(up=up))
    standing = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    for name, camera in turned.cameras.items():
        before = given.cameras[name].cam_from_world
        np.testing.assert_allclose(camera.cam_from_world[:3, 1], before[:3, :3] @ standing, atol=1e-12)
        np.testing.assert_array_equal(camera.cam_from_world[:3, 3], before[:3, 3])
    # The person moves with the cameras: joints have the same places in each camera.
    body = load_body()
    places = [body.forward(c.params(1)).joints[0] for c in (given, turned)]
    for name in given.cameras:
        seen = [p @ c.cameras[name].cam_from_world[:3, :3].T for p, c in zip(places, (given, turned), strict=True)]
        np.testing.assert_allclose(*seen, atol=1e-5)
    with pytest.raises(InputError, match="--units"):
        open_capture(root, rig=RigOptions(units="mm"))
    with pytest.raises(InputError, match="stacked parameters"):
        open_capture(write_avatarrex(scene, tmp_path / "other"), rig=RigOptions(up=up))


def test_stacked_v_shape_follows_the_rows(tmp_path):
    """A row a frame, one of them not finite, and one row for all."""
    root = write_avatarrex(make_scene(), tmp_path / "set")
    with np.load(root / "smpl_params.npz") as file:
        arrays = dict(file)
    offsets = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    np.savez(root / "smpl_params.npz", **arrays, v_shape=offsets)
    np.testing.assert_array_equal(open_capture(root).params(1).v_shape, offsets[1:])
    spoiled = arrays | {"transl": arrays["transl"] * [[np.nan], [1.0]]}
    np.savez(root / "smpl_params.npz", **spoiled, v_shape=offsets)
    np.testing.assert_array_equal(open_capture(root).params(1).v_shape, offsets[1:])
    np.savez(root / "smpl_params.npz", **spoiled, v_shape=offsets[0])
    np.testing.assert_array_equal(open_capture(root).params(1).v_shape, offsets[:1])


def test_frames_with_numbers_that_are_none_are_left_aside(tmp_path):
    root = write_thuman4(make_scene(names=("cam00", "cam01", "cam02")), tmp_path / "set")
    image = root / "images" / "cam00" / "00000001.jpg"
    image.with_name("9" * 30 + ".jpg").write_bytes(image.read_bytes())
    assert open_capture(root).frames == (0, 1)
    with pytest.raises(InputError, match="numbers up to"):
        FileSeries.from_names(root, {10**30: "a.jpg"})
    params = open_capture(root).params(0)
    with pytest.raises(InputError, match="frames numbered below"):
        save_params_by_row(tmp_path / "params.npz", {10**12: params})


JUNK = [None, True, -1, 1.5, 1e308, 10**400, "x", "a\0b", "9" * 30, [], [None], [[1, 2], 3], {}, {"a": 1}, "\ud800"]


@pytest.mark.parametrize("junk", JUNK, ids=lambda value: repr(value)[:12])
@pytest.mark.parametrize(
    ("write", "file", "place"),
    [
        (write_talkbody4d, "calibration.json", ("cameras", "A")),
        (write_talkbody4d, "calibration.json", ("cameras", "A", "image_size")),
        (write_talkbody4d, "calibration.json", ("cameras", "A", "K")),
        (write_talkbody4d, "calibration.json", ("camera_poses", "A")),
        (write_talkbody4d, "calibration.json", ("camera_poses", "A", "R")),
        (write_talkbody4d, "smplx/000000.json", ("Rh",)),
        (write_talkbody4d, "smplx/000000.json", ("betas",)),
        (write_avatarrex, "calibration_full.json", ("A",)),
        (write_avatarrex, "calibration_full.json", ("A", "imgSize")),
        (write_avatarrex, "calibration_full.json", ("A", "imgSize", 0)),
        (write_avatarrex, "calibration_full.json", ("A", "T")),
        (write_easymocap, "output/smpl/smpl/000000.json", (0, "poses")),
        (write_easymocap, "output/smpl/smpl/000000.json", (0, "Th")),
        (write_easymocap, "output/smpl/smpl/000000.json", (0, "shapes")),
        (write_easymocap, "output/smpl/smpl/000000.json", (0,)),
    ],
)
def test_values_of_other_types_are_refused_or_spoil_their_frame(scenes, tmp_path, write, file, place, junk):
    """Never another exception than ours, whatever the value; parameters spoil their own frame alone."""
    root = tmp_path / "set"
    shutil.copytree(scenes[write], root)
    content = json.loads((root / file).read_text())
    *above, last = place
    inner = content
    for key in above:
        inner = inner[key]
    inner[last] = junk
    (root / file).write_text(json.dumps(content))
    if "000000" not in file:
        with pytest.raises(InputError):
            open_capture(root)
        return
    capture = open_capture(root)
    assert {problem.frame for problem in find_problems(capture, decode=False)} <= {0, None}
    assert capture.params(1) is not None


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    scene = make_scene(lens=LENS)
    return {
        write: write(scene, tmp_path_factory.mktemp("scenes") / write.__name__)
        for write in (write_talkbody4d, write_avatarrex, write_easymocap)
    }


@pytest.mark.parametrize(
    "text",
    [
        b"W_A: .Inf\r\nH_A: 100\r\n",
        b"W_A: 9e999\r\nH_A: 1e999\r\n",
        b"K_A: !!opencv-matrix\r\n  rows: 3\r\n  cols: 3\r\n  data: [.Nan, 0, 0, 0, 1, 0, 0, 0, 1]\r\n",
        b"K_A: !!opencv-matrix\r\n  rows: 99999999999999999999\r\n  cols: 3\r\n  data: [1]\r\n",
        b'names:\r\n  - "../A"\r\n',
        b"names: 3\r\n",
    ],
)
def test_easymocap_cameras_with_numbers_that_are_none_are_refused(scenes, tmp_path, text):
    root = tmp_path / "set"
    shutil.copytree(scenes[write_easymocap], root)
    path = root / "intri.yml"
    key = text.split(b":")[0]
    kept = b"".join(block for block in _blocks(path.read_bytes()) if not block.startswith(key + b":"))
    path.write_bytes(kept + text)
    with pytest.raises(InputError):
        open_capture(root)


def _blocks(data: bytes) -> list[bytes]:
    """Top-level entries of the YAML, each with its lines."""
    out: list[bytes] = []
    for line in data.splitlines(keepends=True):
        if line[:1] in b" -" and out:
            out[-1] += line
        else:
            out.append(line)
    return out


def test_a_calibration_table_without_names_is_refused(tmp_path):
    root = write_actorshq(make_scene(), tmp_path / "set")
    table = root / "4x" / "calibration.csv"
    table.write_text(table.read_text().replace("name,", "nome,"))
    with pytest.raises(InputError, match=r"calibration\.csv: expected ActorsHQ columns name, .*'name'"):
        open_capture(root)


@pytest.fixture
def alone(tmp_path) -> Path:
    """A folder above which, as far as a calibration is looked for, nothing else lies."""
    folder = tmp_path / "day" / "session" / "take"
    folder.mkdir(parents=True)
    return folder


def test_an_unknown_folder_is_told_the_nearest_layouts_a_line_each(alone, capsys):
    """All layouts in one line of 700 characters said nothing."""
    (alone / "images" / "cam1").mkdir(parents=True)
    (alone / "intri.yml").write_text("%YAML:1.0\n")
    write_calibration(make_rig(count=3), _made(alone.parent / "calibration"))
    with pytest.raises(InputError) as found:
        open_capture(alone)
    assert len(str(found.value)) < 300 and len(found.value.__notes__) == 3
    assert found.value.__notes__[0] == "easymocap: intri.yml and extri.yml (there: intri.yml)"
    assert main(["capture", "check", str(alone)]) == 2
    shown = capsys.readouterr()
    assert "\n  easymocap: intri.yml and extri.yml (there: intri.yml)\n" in shown.out + shown.err


def test_videos_without_a_calibration_of_theirs_are_told_so(alone):
    (_made(alone / "videos") / "cam1.mp4").write_bytes(b"")
    with pytest.raises(InputError) as found:
        open_capture(alone)
    assert found.value.__notes__[0].startswith("rig: videos or folders of keypoints are there; a calibration")
    other = write_calibration(make_rig(count=3), _made(alone.parent / "calibration"))
    with pytest.raises(InputError) as found:
        open_capture(alone)
    assert f"are there, but not of two cameras of {other} (cam_01, " in found.value.__notes__[0]


def test_photographs_of_one_camera_are_told_of_the_turn(alone):
    for k in range(8):
        (alone / "images").mkdir(exist_ok=True)
        (alone / "images" / f"IMG_{k:04d}.JPG").write_bytes(b"")
    with pytest.raises(InputError) as found:
        open_capture(alone)
    assert found.value.__notes__[0].startswith("rig: photographs are there; a calibration")
    assert "smplxpp capture turntable" in found.value.__notes__[0]


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
