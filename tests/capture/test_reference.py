from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from smplxpp.capture import find_reference, read_cameras
from smplxpp.core import BodyParams, InputError


@pytest.fixture
def capture(tmp_path):
    for folder in ("scans", "params", "labels/A"):
        (tmp_path / "actor" / folder).mkdir(parents=True)
    root = tmp_path / "actor"
    trimesh.creation.box().export(root / "scans/scan_000003.ply")
    np.savez(root / "scans/scan_000003_labels.npz", label=np.zeros(8))
    BodyParams.rest().save(root / "params/params.npz")
    (root / "labels/A/A_label000003.png").write_bytes(b"")
    (root / "labels/A/A_label000004.png").write_bytes(b"")
    return root


def test_files_of_a_frame_are_found_by_name(capture):
    found = find_reference(capture, frame=3)
    assert (found.subject, found.scan.name, found.params_frame) == ("actor", "scan_000003.ply", 3)
    assert found.scan_labels.name == "scan_000003_labels.npz"
    assert {k: v.name for k, v in found.label_maps.items()} == {"A": "A_label000003.png"}
    assert found.cameras_file is None


def test_a_frames_own_parameter_file_comes_first(capture):
    BodyParams.rest().save(capture / "params/000003.npz")
    found = find_reference(capture, frame=3)
    assert (found.params.name, found.params_frame) == ("000003.npz", 0)
    named = find_reference(capture, frame=3, params="params.npz")
    assert (named.params.name, named.params_frame) == ("params.npz", 3)


def test_what_is_missing_is_named(capture, tmp_path):
    with pytest.raises(InputError, match=r"scan_000000\.ply.*scan_000003\.ply.*--frame"):
        find_reference(capture)
    with pytest.raises(InputError, match="existing folder"):
        find_reference(tmp_path / "nobody")
    (capture / "params/params.npz").unlink()
    with pytest.raises(InputError, match="params convert"):
        find_reference(capture, frame=3)


def _camera_entry(name: str = "A") -> dict:
    rotation = trimesh.transformations.rotation_matrix(0.4, [1, 2, 3])[:3, :3]
    K = [[900.0, 0, 192], [0, 900.0, 320], [0, 0, 1]]
    return {"name": name, "w": 384, "h": 640, "K": K, "R": rotation.tolist(), "T": [0.1, -0.2, 3.0]}


def test_both_camera_layouts_cast_the_same_rays(tmp_path):
    entry = _camera_entry()
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [entry]}))
    world_from_cam = np.linalg.inv(np.vstack([np.column_stack([entry["R"], entry["T"]]), [0, 0, 0, 1]]))
    angle, axis, _ = trimesh.transformations.rotation_from_matrix(world_from_cam)
    row = ["A", 384, 640, *(angle * axis), *world_from_cam[:3, 3], 900 / 384, 900 / 640, 0.5, 0.5]
    header = "name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"
    (tmp_path / "calibration.csv").write_text(header + "\n" + ",".join(map(str, row)) + "\n")
    points = np.random.default_rng(0).normal(size=(50, 3))
    a, b = (read_cameras(tmp_path / name)[0].screen_from_world(points) for name in ("cameras.json", "calibration.csv"))
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-7)


def test_ground_truth_capture_has_the_same_cameras_in_both_files(captures):
    root = captures / "woman_casual"
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.3
    for a, b in zip(read_cameras(root / "cameras.json"), read_cameras(root / "calibration.csv"), strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.screen_from_world(points), b.screen_from_world(points), rtol=2e-5, atol=2e-3)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("c.json", "{", "expected JSON"),
        ("c.json", '{"cameras": [{"name": "A"}]}', "an entry 'K'"),
        ("c.csv", "name,w\nA,3\n", "KeyError"),
        ("c.txt", "", r"\.json or \.csv"),
    ],
)
def test_broken_camera_files_are_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words):
        read_cameras(tmp_path / name)
