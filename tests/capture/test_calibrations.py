"""Calibration files of other tools: known points fall where each tool's own projection puts them."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smplxpp.capture.calibrations import FORMATS, find_calibration, format_of, read_calibration
from smplxpp.capture.calibrations.xml_files import read_vicon
from smplxpp.capture.files import matched_names
from smplxpp.core import Camera, InputError
from smplxpp.core.files.markup_file import read_toml, read_xml
from tests.capture.calibration_writers import DIST, WRITERS, Z_UP, Rig, opencv_K, pose_in

POINTS = np.random.default_rng(0).uniform([-0.6, 0.0, -0.6], [0.6, 1.9, 0.6], (40, 3))


def rig(*, roll: float = 0.0, count: int = 4) -> Rig:
    """Cameras on a ring around a person, of uneven focal lengths and principal points."""
    out = {}
    for k in range(count):
        angle = 2 * np.pi * k / count + 0.3
        eye = np.array([3.1 * np.sin(angle), 1.4 + 0.2 * k, 3.1 * np.cos(angle)])
        camera = Camera.look_at(eye=eye, target=np.array([0.05, 0.9, 0.0]), fov_y_deg=52.0, width=640, height=480)
        K = camera.K + np.array([[0, 0, 3.25], [0, 4.0, -2.75], [0, 0, 0]])
        turn = np.eye(4)
        c, s = np.cos(roll), np.sin(roll)
        turn[:2, :2] = [[c, -s], [s, c]]
        out[f"cam_{k + 1:02d}"] = Camera(K, turn @ camera.cam_from_world, 640, 480, name=f"cam_{k + 1:02d}")
    return out


def projected(camera: Camera, dist: tuple[float, ...]) -> np.ndarray:
    """Pixels, centres at +0.5, of the points through a lens k1, k2, p1, p2."""
    x, y, z = (POINTS @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]).T
    x, y = x / z, y / z
    k1, k2, p1, p2 = dist
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    bent = [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    return (np.stack([*bent, np.ones_like(x)], axis=1) @ camera.K.T)[:, :2]


def test_every_format_has_a_writer():
    assert {one.name for one in FORMATS} == set(WRITERS)


@pytest.mark.parametrize("name", WRITERS)
def test_known_points_fall_where_the_tool_projects_them(name, tmp_path):
    true = rig()
    if name == "mvhumannet":  # one lens for all
        true = {key: replace(camera, K=true["cam_01"].K) for key, camera in true.items()}
    path = WRITERS[name](true, tmp_path)
    assert format_of(path).name == name
    own = {key: (640, 480) for key in true}
    sizes = {"shelf": {f"Camera{k}": (640, 480) for k in range(4)}, "mvhumannet": own, "humman": own}
    read = read_calibration(path, sizes=sizes.get(name))
    assert read.format == name and len(read.cameras) == 4
    for expected, (key, camera) in zip(true.values(), read.cameras.items(), strict=True):
        assert (camera.width, camera.height) == (640, 480)
        lens = read.distortions.get(key)
        dist = (0.0, 0.0, 0.0, 0.0) if lens is None else (*lens.radial[:2], *lens.tangential)
        np.testing.assert_allclose(projected(camera, dist), projected(expected, dist), atol=1e-6)
        np.testing.assert_allclose(dist, (0.0,) * 4 if name == "vicon" else DIST, atol=1e-12)


def _rows(matrix: np.ndarray, style: str) -> str:
    """A matrix as Python's YAML libraries write nested lists: dashed, in brackets, half and half; as ROS writes it."""
    rows = np.atleast_2d(matrix).tolist()
    return {
        "dashes": "".join("\n- " + "\n  ".join(f"- {value!r}" for value in row) for row in rows),
        "brackets": f" {rows}",
        "both": "".join(f"\n- {row}" for row in rows),
        "ros": f"\n  rows: {len(rows)}\n  cols: {len(rows[0])}\n  data: {np.ravel(matrix).tolist()}",
        "flat": f" {np.ravel(matrix).tolist()}",
    }[style]


@pytest.mark.parametrize("style", ["dashes", "brackets", "both", "ros", "flat"])
@pytest.mark.parametrize("names", ["camera_matrix dist_coeff R T", "Camera_Matrix Distortion_Coefficients rvec tvec"])
def test_yaml_of_other_writers_than_opencv(style, names, tmp_path):
    true = rig()
    for name, camera in true.items():
        R, T = pose_in(camera, Z_UP, 1.0)
        turn = Rotation.from_matrix(R).as_rotvec()[:, None] if "rvec" in names else R
        values = (opencv_K(camera), np.array(DIST), turn, T[:, None])
        text = "".join(f"{key}:{_rows(value, style)}\n" for key, value in zip(names.split(), values, strict=True))
        (tmp_path / f"{name}.yaml").write_text(f"# by hand\nimage_width: 640\n{text}image_height: 480\n")
    read = read_calibration(tmp_path)
    for expected, (key, camera) in zip(true.values(), read.cameras.items(), strict=True):
        np.testing.assert_allclose(projected(camera, DIST), projected(expected, DIST), atol=1e-6)
        np.testing.assert_allclose(read.distortions[key].radial[:2], DIST[:2])


def test_transposed_matrices_are_those_of_row_vectors(tmp_path):
    """MATLAB's convention, which JARVIS keeps in OpenCV's YAML: intrinsics and rotation are both transposed."""
    true = rig()
    for name, camera in true.items():
        R, T = pose_in(camera, Z_UP, 1e-3)
        values = {"intrinsicMatrix": opencv_K(camera).T, "distortionCoefficients": np.array(DIST), "R": R.T, "T": T}
        text = "".join(f"{key}:{_rows(value, 'ros')}\n" for key, value in values.items())
        (tmp_path / f"{name}.yaml").write_text(text)
    read = read_calibration(tmp_path, sizes={key: (640, 480) for key in true})
    for expected, camera in zip(true.values(), read.cameras.values(), strict=True):
        np.testing.assert_allclose(projected(camera, DIST), projected(expected, DIST), atol=1e-6)


def test_the_folder_is_enough_and_settings_of_the_tool_are_passed_over(tmp_path):
    (tmp_path / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    (tmp_path / "notes.txt").write_text("nothing")
    assert find_calibration(tmp_path) is None
    path = WRITERS["qualisys"](rig(), tmp_path)
    assert find_calibration(tmp_path) == path and list(read_calibration(tmp_path).cameras) == list(rig())
    with pytest.raises(InputError, match=r"pose2sim \(Calib\*\.toml\).*content of none"):
        read_calibration(tmp_path / "Config.toml")


def test_units_and_axes_are_the_users_before_the_formats_before_a_guess(tmp_path):
    path = WRITERS["anipose"](rig(), tmp_path)
    read = read_calibration(path)
    assert any("unit taken for mm" in note for note in read.notes) and any(
        "z taken for up" in note for note in read.notes
    )
    inches = read_calibration(path, units="inch", up="z").cameras["cam_01"]
    np.testing.assert_allclose(inches.position, 25.4 * rig()["cam_01"].position, rtol=1e-9)
    lying = read_calibration(path, up="y").cameras["cam_01"]
    np.testing.assert_allclose(lying.position, Z_UP.T @ rig()["cam_01"].position, atol=1e-9)
    with pytest.raises(InputError, match="--up"):
        read_calibration(path, up="up")


def test_a_board_of_opencap_that_lies_on_the_ground_has_z_down(tmp_path):
    """The same cameras, once with the world of a standing board and once with that of one that lies."""
    path = WRITERS["opencap"](rig(), tmp_path)
    standing = read_calibration(path)
    lying = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # rows: axes of the lying board in the standing one's world
    for file in (tmp_path / "Videos").glob("*/*.pickle"):
        content = pickle.loads(file.read_bytes())
        content["rotation"] = content["rotation"] @ lying.T
        file.write_bytes(pickle.dumps(content))
    read = read_calibration(path)
    assert not read.notes
    for camera, expected in zip(read.cameras.values(), standing.cameras.values(), strict=True):
        np.testing.assert_allclose(camera.K, expected.K)
        # Both worlds stand on y, and may differ by a turn about it.
        np.testing.assert_allclose(camera.cam_from_world[:3, 1], expected.cam_from_world[:3, 1], atol=1e-9)
        np.testing.assert_allclose(camera.cam_from_world[:3, 3], expected.cam_from_world[:3, 3], atol=1e-9)


def test_pictures_that_lie_on_their_side_do_not_tell_where_up_is(tmp_path):
    """Phones that all stand on end: their upper edges point around the circle, and their sum nowhere."""
    with pytest.raises(InputError, match="Name the axis: --up z"):
        read_calibration(WRITERS["pose2sim"](rig(roll=np.pi / 2), tmp_path))
    read = read_calibration(tmp_path, up="z")
    np.testing.assert_allclose(read.cameras["cam_02"].position, rig()["cam_02"].position, atol=1e-9)


def test_images_of_another_size_scale_the_camera_and_turned_ones_are_refused(tmp_path):
    path = WRITERS["pose2sim"](rig(), tmp_path)
    plain = read_calibration(path).cameras["cam_02"]
    half = read_calibration(path, sizes={"cam2": (320, 240)}).cameras["cam_02"]
    assert (half.width, half.height) == (320, 240)
    np.testing.assert_allclose(half.K[:2], 0.5 * plain.K[:2], rtol=1e-12)
    padded = read_calibration(path, sizes={"cam2_video": (640, 488)})
    assert (padded.cameras["cam_02"].width, padded.cameras["cam_02"].height) == (640, 480)
    assert any("cam_02: images of 640 x 488" in note for note in padded.notes)
    with pytest.raises(InputError, match="Rotate the images"):
        read_calibration(path, sizes={"cam_02": (480, 640)})


def test_vicons_polynomial_is_inverted_within_the_image(tmp_path):
    """It takes a seen radius in pixels to the true one; the distortion that is read takes true ones to seen ones."""
    path = WRITERS["vicon"](rig(), tmp_path)
    k1, k2 = 3e-8, 4e-14
    path.write_text(path.read_text().replace(' 0 0 0"/>', f' {k1} {k2} 0"/>'))
    read = read_calibration(path)
    camera, lens = read.cameras["cam_01"], read.distortions["cam_01"]
    focal = camera.K[0, 0]
    seen = np.linspace(5.0, 395.0, 30)  # half a diagonal has 400 pixels
    true = seen * (1 + k1 * seen**2 + k2 * seen**4) / focal
    bent = lens.distort(np.stack([true, np.zeros_like(true)], axis=1))[:, 0] * focal
    assert np.abs(true * focal - seen).max() > 2.0
    np.testing.assert_allclose(bent, seen, atol=0.01)
    assert read_vicon(path, read_xml(path)).metres == 1e-3


@pytest.mark.parametrize(
    ("cameras", "files", "expected"),
    [
        (["cam_01", "cam_02"], ["cam02_json", "cam01_json"], {"cam_01": "cam01_json", "cam_02": "cam02_json"}),
        (["cam1", "cam10"], ["cam10", "cam1"], {"cam1": "cam1", "cam10": "cam10"}),
        (["22054", "22055"], ["Miqus_3_22055", "Miqus_1_22054"], {"22054": "Miqus_1_22054", "22055": "Miqus_3_22055"}),
        (["00_00", "00_10"], ["hd_00_00", "hd_00_10"], {"00_00": "hd_00_00", "00_10": "hd_00_10"}),
        (["A", "B"], ["Camera_B", "Camera_A"], {"A": "Camera_A", "B": "Camera_B"}),
        (["A", "B"], ["vid1-camB", "vid1-camA"], {"A": "vid1-camA", "B": "vid1-camB"}),
        (["int_cam_1", "int_cam_2"], ["view1", "view2"], {"int_cam_1": "view1", "int_cam_2": "view2"}),
        (["left", "right"], ["cam1", "cam2"], {}),
        (["cam1_a", "cam1_b"], ["view1"], {}),
    ],
)
def test_names_of_cameras_in_other_spellings(cameras, files, expected):
    assert matched_names(cameras, files) == expected


def test_a_document_type_and_broken_files_are_refused(tmp_path):
    path = tmp_path / "x.xcp"
    path.write_text('<!DOCTYPE a [<!ENTITY b "c">]><Cameras>&b;</Cameras>')
    with pytest.raises(InputError, match="document type"):
        read_xml(path)
    path.write_text("<a>" * 100 + "</a>" * 100)
    with pytest.raises(InputError, match="64 levels"):
        read_xml(path)
    (tmp_path / "x.toml").write_text("[cam\n")
    with pytest.raises(InputError, match="TOML"):
        read_toml(tmp_path / "x.toml")


@pytest.mark.parametrize("name", ["pose2sim", "qualisys", "optitrack", "panoptic"])
def test_a_camera_without_a_number_is_named(name, tmp_path):
    path: Path = WRITERS[name](rig(), tmp_path)
    text = path.read_bytes()
    broken = {
        "pose2sim": (b"rotation = [", b"rotation = [1.0, "),
        "qualisys": (b'focalLengthU="', b'focalLengthU="x'),
        "optitrack": ('OrientMatrix4="'.encode("utf-16-le"), 'OrientMatrix4="nan'.encode("utf-16-le")),
        "panoptic": (b'"R": [[', b'"R": [[null, '),
    }[name]
    path.write_bytes(text.replace(*broken) if name in ("qualisys", "panoptic") else text.replace(*broken, 1))
    with pytest.raises(InputError, match=r"cam_01|01_01"):
        read_calibration(path)


def test_the_writers_use_other_axes_than_ours():
    R, T = pose_in(rig()["cam_01"], Z_UP, 1e-3)
    assert abs(np.linalg.det(R) - 1) < 1e-12 and np.linalg.norm(-R.T @ T) > 3000
    assert opencv_K(rig()["cam_01"])[0, 2] == rig()["cam_01"].K[0, 2] - 0.5
