"""A tracker's errors have the stated size, are where they belong, and are the same for the same seed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from pipelines.cli import main
from smplxpp.body import load_body
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.capture import find_problems, open_capture
from smplxpp.core import BodyParams, Camera, InputError
from smplxpp.synth.tracker import DetectorConfig, detector_keypoints, estimated_labels
from smplxpp.synth.write_capture import add_tracked_inputs
from tests.capture.scene import LENS, make_scene
from tests.capture.writers import write_simple

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"


def looking(height: int) -> Camera:
    eye, target = np.array([0.0, 1.0, 4.0]), np.array([0.0, 1.0, 0.0])
    return Camera.look_at(eye=eye, target=target, fov_y_deg=40, width=height, height=height)


def cloud(frames: int = 40, count: int = 50) -> np.ndarray:
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (frames, count, 3))
    return points + [0.0, 1.0, 0.0]


def detect(points: np.ndarray, height: int, config: DetectorConfig | None = None, **more):
    names = [f"p{k}" for k in range(points.shape[1])]
    return detector_keypoints(
        points, looking(height), names=names, frames=range(len(points)), seed=more.pop("seed", 3), config=config, **more
    )


@pytest.mark.parametrize("height", [640, 320])
def test_a_detector_errs_as_stated(height):
    points = cloud()
    exact = looking(height).screen_from_world(points.reshape(-1, 3))[:, :2].reshape(*points.shape[:2], 2)
    found = detect(points, height)
    seen = found.confidence > 0
    off = (found.points - exact)[seen]
    # 3 px at 640 px of height, the median of absolute values of a normal distribution, and outliers beside it.
    assert np.median(np.abs(off)) == pytest.approx(0.6745 * 3.0 * height / 640 * 1.06, rel=0.05)
    far = np.linalg.norm(off, axis=1) > 5 * 3.0 * height / 640
    assert far.mean() == pytest.approx(0.05, abs=0.015) and 1 - seen.mean() == pytest.approx(0.10, abs=0.02)
    low, high = exact.min(axis=1).min(axis=0), exact.max(axis=1).max(axis=0)
    assert (found.points[seen][far] >= low).all() and (found.points[seen][far] <= high).all()
    again, other = detect(points, height), detect(points, height, seed=4)
    assert (found.points == again.points).all() and not (found.points == other.points).all()


def test_hidden_points_are_less_sure_and_what_is_outside_is_not_found():
    points = cloud()
    points[:, 0] += [5.0, 0.0, 0.0]  # out of the picture
    points[:, 1] += [0.0, 0.0, 9.0]  # behind the camera
    visible = np.ones(points.shape[:2], dtype=bool)
    visible[:, 2:20] = False
    found = detect(points, 640, DetectorConfig(outliers=0.0, missing=0.0), visible=visible)
    assert (found.confidence[:, :2] == 0).all() and (found.confidence[:, 2:] > 0).all()
    assert found.confidence[:, 2:20].max() < 0.56 and found.confidence[:, 20:].min() > 0.59
    with pytest.raises(InputError, match="missing"):
        DetectorConfig(missing=1.5)


@pytest.mark.parametrize("camera", ["Cam001", "Cam004", "Face1"])
def test_a_parser_errs_at_borders_on_a_twentieth_of_the_person(camera):
    exact = open_capture(FIXTURE).labels(camera, 4)
    found = estimated_labels(exact, seed=7)
    assert found.dtype == exact.dtype and ((found == 0) == (exact == 0)).all()
    wrong = found != exact
    assert wrong[exact > 0].mean() == pytest.approx(0.05, abs=0.012)
    # What is wrong lies near another label, and in pieces, not in grains.
    changes = np.zeros(exact.shape, dtype=bool)
    changes[:, 1:] |= (exact[:, 1:] != exact[:, :-1]) & (exact[:, 1:] > 0) & (exact[:, :-1] > 0)
    changes[1:] |= (exact[1:] != exact[:-1]) & (exact[1:] > 0) & (exact[:-1] > 0)
    away = distance_transform_edt(~changes)
    assert np.percentile(away[wrong], 90) < 0.06 * len(exact)
    neighbours = sum(np.roll(wrong, step, axis) for axis in (0, 1) for step in (-1, 1))
    assert (neighbours[wrong] == 0).mean() < 0.06
    assert (estimated_labels(exact, seed=7) == found).all() and (estimated_labels(exact, seed=8) != found).any()


def test_a_parser_has_nothing_to_err_about_where_there_is_one_label():
    plain = np.zeros((40, 30), np.uint8)
    plain[10:30, 5:25] = 4
    assert (estimated_labels(plain, seed=0) == plain).all()
    assert not estimated_labels(np.zeros((8, 8), np.uint8), seed=0).any()


def test_the_shipped_fixture_has_what_its_seed_gives():
    capture = open_capture(FIXTURE)
    exact = capture.labels("Cam003", 5)
    row = list(capture.cameras).index("Cam003")
    series = capture.file("Cam003", 5, "label")
    shipped = FIXTURE / "labels_estimated" / "Cam003" / series.name
    from PIL import Image

    assert (np.asarray(Image.open(shipped)) == estimated_labels(exact, seed=[0, 12, row, 5])).all()
    params = BodyParams.concatenate([capture.params(frame) for frame in capture.frames])
    joints = load_body().forward(params).joints
    for name, camera in capture.cameras.items():
        found = capture.keypoints(name)
        assert found.names == SMPLX_JOINTS and tuple(found.frames) == capture.frames
        uv = camera.screen_from_world(joints.reshape(-1, 3))[:, :2].reshape(*joints.shape[:2], 2)
        off = np.abs(found.points - uv)[found.confidence > 0.56]
        assert np.median(off) == pytest.approx(0.6745 * 3 * camera.height / 640, rel=0.25)


def test_exact_inputs_have_no_keypoints():
    assert open_capture(FIXTURE, protocol="exact").keypoints("Cam001") is None
    tracked = open_capture(FIXTURE, protocol="tracked")
    assert tracked.keypoints("Cam001") is not None and tracked.normals("Cam001", 0) is None
    assert (tracked.labels("Cam001", 4) != open_capture(FIXTURE, protocol="exact").labels("Cam001", 4)).any()


@pytest.fixture
def scene_capture(tmp_path) -> Path:
    """Photographs through a lens, without label maps, with a file of parameters a frame."""
    return write_simple(make_scene(lens=LENS), tmp_path / "exact")


def test_a_degraded_capture_has_both_protocols(scene_capture, tmp_path, capsys):
    out = tmp_path / "tracked"
    (scene_capture / "keypoints").mkdir()
    (scene_capture / "keypoints" / "A.npz").write_bytes(b"exact ones, not to be passed on")
    assert main(["capture", "degrade", str(scene_capture), "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["frames"] == 2 and said["cameras"] == 3 and len(said["left_out"]) == 1
    capture, exact = open_capture(out), open_capture(scene_capture)
    assert find_problems(capture) == [] and capture.views() == exact.views()
    assert (out / "rgbs" / "A" / "A_rgb000000.jpg").is_symlink()
    description = json.loads((out / "capture.json").read_text())
    assert description["background"] is None and set(description) >= {"inputs", "protocols"}
    tracked = description["protocols"]["tracked"]
    assert tracked == {
        "parameters": "params_noisy.npz",
        "labels": None,
        "scan_labels": False,
        "normals": None,
        "keypoints": "keypoints",
    }
    noisy = open_capture(out, params="params_noisy.npz").params(1)
    assert 0 < np.linalg.norm(noisy.transl - exact.params(1).transl) < 0.06
    assert (open_capture(out, params="params.npz").params(1).transl == exact.params(1).transl).all()
    # Through the lens onto the disk, and back: where the undistorted image has the joints.
    joints = load_body().forward(exact.params(0)).joints[0]
    for name, camera in capture.cameras.items():
        found = capture.keypoints(name)
        off = (found.points[0] - camera.screen_from_world(joints)[:, :2])[found.confidence[0] > 0.6]
        assert np.median(np.abs(off)) == pytest.approx(0.6745 * 3 * camera.height / 640, rel=0.6)


def test_degrading_again_gives_the_same_and_refuses_what_is_in_use(scene_capture, tmp_path):
    command = ["capture", "degrade", str(scene_capture), "--copy", "--json", "--out"]
    for name in ("one", "two"):
        assert main([*command, str(tmp_path / name)]) == 0
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert files and not any((tmp_path / "one" / path).is_symlink() for path in files)
    assert all((tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes() for path in files)
    assert main([*command, str(tmp_path / "one")]) == 2
    assert main([*command, str(scene_capture / "inside")]) == 2
    assert main([*command, str(tmp_path / "three"), "--rig", "4"]) == 2  # it has cameras
    assert not (tmp_path / "three").exists()


def test_the_next_command_names_the_protocol_because_exact_inputs_come_first(scene_capture, tmp_path, capsys):
    out = tmp_path / "tracked"
    assert main(["capture", "degrade", str(scene_capture), "--out", str(out)]) == 0
    assert f"smplxpp build RUN --capture {out} --protocol tracked" in capsys.readouterr().out.replace("\n", "")
    exact = open_capture(scene_capture).params(1).transl
    assert (open_capture(out).params(1).transl == exact).all()
    assert (open_capture(out, protocol="tracked").params(1).transl != exact).any()


def test_a_capture_without_cameras_gets_a_ring(scene_capture, tmp_path, capsys):
    bare = tmp_path / "bare"
    (bare / "scans").mkdir(parents=True)
    (bare / "params").symlink_to(scene_capture / "params")
    assert main(["capture", "degrade", str(bare), "--out", str(tmp_path / "none"), "--json"]) == 0
    assert "--rig" in json.loads(capsys.readouterr().out)["left_out"][0]
    assert main(["capture", "degrade", str(bare), "--out", str(tmp_path / "ring"), "--rig", "6", "--json"]) == 0
    capture = open_capture(tmp_path / "ring")
    assert len(capture.cameras) == 6 and find_problems(capture) == []
    assert all(capture.keypoints(name).frames.tolist() == [0, 1] for name in capture.cameras)


def test_label_maps_are_estimated_and_the_manifest_names_them(tmp_path):
    """As a synthetic capture is made, on two of the fixture's views."""
    root = tmp_path / "small"
    for folder in ("params", "rgbs/Cam001", "labels/Cam001"):
        (root / folder).mkdir(parents=True)
    for name in (
        "params/params.npz",
        *(f"{k}s/Cam001/Cam001_{t}000003" for k, t in (("rgb", "rgb"), ("label", "label"))),
    ):
        source = next((FIXTURE / name).parent.glob(Path(name).stem + "*"))
        (root / name).parent.joinpath(source.name).write_bytes(source.read_bytes())
    (root / "cameras.json").write_bytes((FIXTURE / "cameras.json").read_bytes())
    (root / "manifest.json").write_text('{"seed": 0}')
    (root / "capture.json").write_text("{}")
    figures = add_tracked_inputs(root, seed=0)
    assert figures["labels_estimated_wrong_percent"] == pytest.approx(5.0, abs=1.0)
    name = "labels_estimated/Cam001/Cam001_label000003.png"
    assert (root / name).read_bytes() == (FIXTURE / name).read_bytes()
    manifest = json.loads((root / "manifest.json").read_text())
    shipped = json.loads((FIXTURE / "manifest.json").read_text())
    assert manifest["seed"] == 0 and manifest["protocols"] == shipped["protocols"]
