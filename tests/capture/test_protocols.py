"""Protocols of a capture: which of its files are read, what is refused, and that nothing of another leaks in."""

from __future__ import annotations

import json
import pickle
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from smplxpp.capture import find_reference, open_capture
from smplxpp.capture.protocols import ProtocolFiles, choose_protocol, read_description
from smplxpp.core import BodyParams, InputError
from tests.capture.scene import make_scene
from tests.capture.test_capture import H, W, write_capture
from tests.capture.writers import write_actorshq

EXACT = {"parameters": "params.npz", "labels": "labels", "scan_labels": True, "normals": "normals", "keypoints": None}
TRACKED = {
    "parameters": "params_noisy.npz",
    "labels": "labels_estimated",
    "scan_labels": False,
    "normals": None,
    "keypoints": "keypoints",
}


@pytest.fixture
def root(tmp_path):
    """A capture with exact and tracked files; the tracked parameters stand a metre aside, the labels differ."""
    root = write_capture(tmp_path / "actor", description={"protocols": {"exact": EXACT, "tracked": TRACKED}})
    moved = BodyParams.rest(betas=10)
    moved = BodyParams(**{**moved.as_dict(), "transl": np.array([[1.0, 0.0, 0.0]])})
    BodyParams.concatenate([moved] * 4).save(root / "params" / "params_noisy.npz")
    moved.save(root / "params" / "params_registered.npz")
    for folder in ("labels_estimated", "normals"):
        shutil.copytree(root / "labels", root / folder)
    for path in (root / "labels_estimated").rglob("*.png"):
        Image.fromarray(np.full((H, W), 5, np.uint8)).save(path)
    for path in (root / "normals").rglob("*.png"):
        path.unlink()
        Image.new("RGB", (W, H), (128, 128, 255)).save(path.with_name(path.name.replace("label", "normal")))
    (root / "keypoints").mkdir()
    (root / "scans").mkdir()
    trimesh.creation.box().export(root / "scans/scan_000000.ply")
    np.savez(root / "scans/scan_000000_labels.npz", label=np.zeros(8))
    return root


def test_a_protocol_chooses_parameters_labels_and_normals(root):
    exact, tracked, plain = (open_capture(root, protocol=name) for name in ("exact", "tracked", None))
    assert (exact.protocol, tracked.protocol, plain.protocol) == ("exact", "tracked", None)
    assert exact.recording.protocols == plain.recording.protocols == ("exact", "tracked")
    assert [c.params(1).transl[0, 0] for c in (exact, tracked, plain)] == [0.0, 1.0, 0.0]
    assert [set(np.unique(c.labels("A", 0))) for c in (exact, tracked, plain)] == [{0, 3}, {5}, {0, 3}]
    assert [c.normals("A", 0) is None for c in (exact, tracked, plain)] == [False, True, False]
    other = open_capture(root, protocol="tracked", params="params.npz")
    assert other.protocol == "tracked" and other.params(1).transl[0, 0] == 0.0 and other.normals("A", 0) is None


def test_resized_cropped_and_reduced_captures_keep_their_protocol(root):
    capture = open_capture(root, protocol="tracked")
    for one in (
        capture.resized(0.5),
        capture.cropped({"A": (0, 0, 20, 30)}),
        capture.without(capture.problems),
        pickle.loads(pickle.dumps(capture)),
    ):
        assert one.protocol == "tracked" and one.params(0).transl[0, 0] == 1.0


def test_the_reference_frame_follows_the_protocol(root):
    exact, tracked, plain = (find_reference(root, protocol=name) for name in ("exact", "tracked", None))
    for found, params, labels in ((exact, "params.npz", "labels"), (tracked, "params_noisy.npz", "labels_estimated")):
        assert (found.params.name, found.params_frame, found.motion.name) == (params, 0, params)
        assert {path.parts[-3] for path in found.label_maps.values()} == {labels}
    assert exact.scan_labels is not None and plain.scan_labels is not None and tracked.scan_labels is None
    assert plain.motion.name == "params.npz"
    given = find_reference(root, protocol="exact", params="params_noisy.npz")
    assert given.motion.name == "params_noisy.npz"  # exact motion beside a tracker's frame would be a truth unasked for


def test_a_frames_own_exact_file_does_not_go_before_a_protocols(root):
    BodyParams.rest().save(root / "params" / "000000.npz")
    assert find_reference(root).params.name == "000000.npz"
    assert find_reference(root, protocol="tracked").params.name == "params_noisy.npz"
    assert open_capture(root, protocol="tracked").params(0).transl[0, 0] == 1.0


def test_a_protocol_without_parameters_has_none(root):
    content = {"protocols": {"keypoints alone": {"keypoints": "keypoints"}}}
    (root / "capture.json").write_text(json.dumps(content))
    capture = open_capture(root, protocol="keypoints alone")
    assert capture.params(0) is None and capture.labels("A", 0) is None and capture.normals("A", 0) is None
    files = choose_protocol(root, read_description(root), "keypoints alone")
    assert files == ProtocolFiles(
        name="keypoints alone", parameters=None, labels=None, scan_labels=False, normals=None, keypoints="keypoints"
    )
    with pytest.raises(InputError, match=r"a file of parameters.*--params"):
        find_reference(root, protocol="keypoints alone")


def test_an_unknown_protocol_names_those_there_are(root):
    for call in (open_capture, find_reference):
        with pytest.raises(InputError, match=r"exact, tracked.*received noisy"):
            call(root, protocol="noisy")
    (root / "capture.json").unlink()
    with pytest.raises(InputError, match=r"\(none\).*under \"protocols\""):
        open_capture(root, protocol="tracked")


@pytest.mark.parametrize("name", ["params/params_noisy.npz", "labels_estimated", "keypoints"])
def test_files_that_a_protocol_names_and_that_are_missing_are_named(root, name):
    path = root / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    for call in (open_capture, find_reference):
        with pytest.raises(InputError, match=rf"{name}.*another protocol \(exact\)"):
            call(root, protocol="tracked")
    assert open_capture(root, protocol="exact").protocol == "exact"


@pytest.mark.parametrize(
    ("protocol", "message"),
    [
        ({"parameters": "../params.npz"}, "without a path"),
        ({"labels": 3}, "without a path"),
        ({"scan_labels": "no"}, "true or false"),
        ({"label": "labels"}, "keys among parameters"),
        ("tracked", "an object with parameters"),
    ],
)
def test_what_is_no_protocol_is_refused(root, protocol, message):
    (root / "capture.json").write_text(json.dumps({"protocols": {"tracked": protocol}}))
    with pytest.raises(InputError, match=message):
        open_capture(root)


def test_other_layouts_have_no_protocols(tmp_path):
    root = write_actorshq(make_scene(), tmp_path / "set")
    with pytest.raises(InputError, match=r"own layout.*actorshq"):
        open_capture(root, protocol="tracked")
