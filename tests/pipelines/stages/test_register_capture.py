"""The stage of registration: what the solver is shown and what not, the files, what fails alone, what is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from pipelines.runs.layout import LANDMARKS_FILE, REGISTER_STAGE, REGISTERED_PARAMS, REGISTRATION
from pipelines.stages.build import build
from pipelines.stages.build_config import BuildConfig, BuildInputs, RegisterInputs, load_register
from pipelines.stages.register_capture import register_capture
from pipelines.stages.run_inputs import params_in_use
from smplxpp.body import load_params
from smplxpp.capture import Capture, open_capture
from smplxpp.core import LABELS, BodyParams, InputError
from tests.pipelines.registrations import FIXTURE, HELD_OUT, exact, joints_in, use_keypoints, use_solver

TRACKED = FIXTURE / "params" / "params_noisy.npz"
FRAMES = (0, 1, 13)


@pytest.fixture
def asked(monkeypatch):
    return use_keypoints(monkeypatch)


@pytest.fixture
def solver(monkeypatch, asked):
    return use_solver(monkeypatch)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The person without scans, which take a second each."""
    unused = shutil.ignore_patterns("geometry", "normals", "scans")
    return shutil.copytree(FIXTURE, tmp_path_factory.mktemp("plain") / "person", ignore=unused)


@pytest.fixture
def capture(tmp_path):
    """A copy to spoil."""
    return shutil.copytree(FIXTURE, tmp_path / "capture", ignore=shutil.ignore_patterns("geometry", "normals"))


def inputs_of(folder=FIXTURE, **changes) -> RegisterInputs:
    return RegisterInputs(**{"capture": folder, "params": TRACKED, "frames": FRAMES, **changes})


# --- what the solver is shown ---------------------------------------------------------------------------------------


def test_held_out_cameras_are_never_looked_at(tmp_path, solver, asked, plain):
    register_capture(tmp_path, inputs_of(plain, frames=None))
    (shown,) = solver.shown
    splits = open_capture(FIXTURE).splits
    assert tuple(shown.cameras) == splits.train_cameras and HELD_OUT not in shown.keypoints
    assert set(asked) == set(splits.train_cameras)
    assert shown.mask(HELD_OUT, 0) is None and shown.labels(HELD_OUT, 0) is None
    assert shown.mask("Cam001", 0).max() == 255


def test_held_out_frames_get_poses_and_no_say_in_the_shape(tmp_path, solver, plain):
    record = register_capture(tmp_path, inputs_of(plain, frames=None))
    (shown,) = solver.shown
    splits = open_capture(FIXTURE).splits
    assert shown.frames == tuple(range(16)) and shown.shape_frames == splits.train_frames
    seen = record.manifest["numbers"]["seen"]
    assert (seen["cameras"], seen["frames"]) == (list(splits.train_cameras), list(splits.train_frames))
    assert json.loads((tmp_path / REGISTRATION).read_text())["held_out_frames"] == [13, 14, 15]


def test_other_cameras_may_be_held_out(tmp_path, solver, plain):
    register_capture(tmp_path, inputs_of(plain, hold_out=("Cam001", "Face1")))
    assert set(solver.shown[0].cameras) == {"Cam002", "Cam003", "Cam004", "Cam005", "Cam006", "Face2"}


def test_label_maps_are_ours_and_255_elsewhere(tmp_path, solver, plain):
    register_capture(tmp_path, inputs_of(plain))
    capture, ours = open_capture(FIXTURE), solver.shown[0].labels("Cam001", 0)
    theirs = capture.labels("Cam001", 0)
    assert ours.dtype == np.uint8 and set(np.unique(ours)) <= {*range(len(LABELS)), 255}
    np.testing.assert_array_equal(ours == 255, theirs == 0)
    np.testing.assert_array_equal(ours == 0, np.isin(theirs, (1, 6)))  # skin, and what is on it


@pytest.mark.long
def test_votes_label_the_scan_unless_a_file_is_named(tmp_path, solver):
    labels = FIXTURE / "scans" / "scan_000000_labels.npz"
    register_capture(tmp_path / "votes", inputs_of())
    register_capture(tmp_path / "given", inputs_of(labels=labels))
    voted, given = (shown.scans[0] for shown in solver.shown)
    np.testing.assert_array_equal(voted.mesh.vertices, given.mesh.vertices)
    assert (given.labels >= 0).all()
    known = voted.labels >= 0
    assert 0.5 < known.mean() < 1.0
    assert (voted.labels == given.labels)[known].mean() > 0.95


def test_the_start_is_the_named_fit_or_none(tmp_path, solver, plain):
    register_capture(tmp_path / "fit", inputs_of(plain))
    register_capture(tmp_path / "none", inputs_of(plain, params=None, start=False))
    fit, none = solver.shown
    np.testing.assert_array_equal(fit.initial.body_pose, load_params(TRACKED).select(list(FRAMES)).body_pose)
    assert none.initial is None and not (tmp_path / "none" / REGISTER_STAGE / "initial.npz").exists()


def test_a_frame_without_a_fit_starts_from_its_neighbours(tmp_path, plain, solver):
    arrays = dict(np.load(TRACKED))
    arrays["transl"][1] = np.nan
    np.savez(tmp_path / "gaps.npz", **arrays)
    register_capture(tmp_path / "run", inputs_of(plain, params=tmp_path / "gaps.npz"))
    np.testing.assert_array_equal(solver.shown[0].initial.transl[1], solver.shown[0].initial.transl[0])
    problems = json.loads((tmp_path / "run" / REGISTRATION).read_text())["problems"]
    assert any("frame 1: no fit to start from, that of frame 0" in words for words in problems)


def test_one_scan_with_a_fit(tmp_path, solver):
    scan = FIXTURE / "scans" / "scan_000000.ply"
    register_capture(tmp_path, RegisterInputs(scan=scan, params=TRACKED, frame=3))
    (shown,) = solver.shown
    assert shown.frames == (3,) and not shown.cameras and shown.scans[3].labels is None
    np.testing.assert_array_equal(shown.initial.transl[0], load_params(TRACKED).transl[3])


# --- landmarks placed by hand ---------------------------------------------------------------------------------------


def place(run, **points) -> None:
    run.mkdir(exist_ok=True)
    (run / LANDMARKS_FILE).write_text(json.dumps(points))


def test_landmarks_in_the_run_are_seen_and_change_the_stage(tmp_path, plain, solver):
    assert register_capture(tmp_path, inputs_of(plain)).ran
    place(tmp_path, nose=[0.0, 1.5, 0.1], pelvis=[0.0, 1.0, 0.0])
    record = register_capture(tmp_path, inputs_of(plain))
    assert record.ran and not register_capture(tmp_path, inputs_of(plain)).ran
    before, shown = solver.shown
    assert not before.landmarks and set(shown.landmarks) == {0}
    assert shown.landmarks[0]["pelvis"].tolist() == [0.0, 1.0, 0.0]
    assert json.loads((tmp_path / REGISTRATION).read_text())["seen"]["landmarks"] == 2
    assert (tmp_path / LANDMARKS_FILE).is_file()
    register_capture(tmp_path, inputs_of(plain, frames=(1, 13)))  # they are of frame 0
    assert not solver.shown[-1].landmarks


def test_a_scan_with_landmarks_needs_no_fit(tmp_path, solver):
    place(tmp_path, nose=[0.0, 1.5, 0.1], left_shoulder=[0.2, 1.4, 0.0])
    scan = FIXTURE / "scans" / "scan_000000.ply"
    register_capture(tmp_path, RegisterInputs(scan=scan, frame=3))
    (shown,) = solver.shown
    assert shown.initial is None and set(shown.landmarks[3]) == {"nose", "left_shoulder"}
    place(tmp_path, tail=[0.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"joints of the body.*received tail"):
        register_capture(tmp_path, RegisterInputs(scan=scan, frame=3))


# --- files and gates ------------------------------------------------------------------------------------------------


def test_rows_are_frames_and_a_capture_reads_them(tmp_path, monkeypatch, asked, plain):
    use_solver(monkeypatch, fails=(1,))
    record = register_capture(tmp_path, inputs_of(plain))
    capture = open_capture(FIXTURE, params=tmp_path / REGISTERED_PARAMS)
    np.testing.assert_array_equal(capture.params(13).transl, exact().frame(13).transl)
    assert capture.params(1) is None is capture.params(14)
    assert record.manifest["numbers"]["absent"] == [1]
    with np.load(record.folder / "confidence.npz") as data:
        assert data["frames"].tolist() == [0, 13] and data["confidence"].shape == (2, len(data["joint_names"]))
    content = json.loads((tmp_path / REGISTRATION).read_text())
    assert "frame 1: nobody is in the pictures" in content["problems"] and content["absent"] == [1]
    # Exact joints against exact keypoints; before, the tracker's noise.
    for found in content["by_camera"].values():
        assert found["after"]["median_px"] < 1e-6 < 0.3 < found["before"]["median_px"]
    assert set(content["by_camera"]) == set(open_capture(FIXTURE).splits.train_cameras)


def test_gates_say_what_is_doubtful(tmp_path, monkeypatch, asked):
    use_solver(monkeypatch, fails=(1,), doubtful=(13,))
    checks = {c["name"]: c for c in register_capture(tmp_path, inputs_of()).manifest["checks"]}
    assert checks["keypoints to the body"]["status"] == checks["bare skin to the scan"]["status"] == "pass"
    assert checks["share of frames registered"]["status"] == "fail"
    assert "without frames 1" in checks["share of frames registered"]["explanation"]
    confident = checks["share of frames with a confident fit"]
    assert confident["status"] == "warn" and confident["value"] == 0.5 and "frames 13" in confident["explanation"]


def test_no_frame_at_all_is_an_error(tmp_path, monkeypatch, asked, plain):
    use_solver(monkeypatch, fails=FRAMES)
    with pytest.raises(InputError, match="nobody is in the pictures"):
        register_capture(tmp_path, inputs_of(plain))
    assert not (tmp_path / REGISTER_STAGE).exists()


@pytest.mark.long
def test_it_is_skipped_while_nothing_changed(tmp_path, capture, solver, monkeypatch):
    run = tmp_path / "run"
    shutil.rmtree(capture / "scans")

    def ran(**changes) -> bool:
        return register_capture(run, inputs_of(capture, **changes)).ran

    assert ran() and not ran()
    assert load_register(run) == inputs_of(capture)
    assert ran(frames=(0, 1)) and ran() and ran(hold_out=("Cam001",)) and ran(seed=1) and ran()
    mask = capture / "masks" / "Cam001" / "Cam001_mask000001.png"
    mask.write_bytes(mask.read_bytes() + b"\0")
    assert ran()
    surer = lambda self, name: replace(joints_in(self, name), confidence=np.ones((16, 55)))  # noqa: E731
    monkeypatch.setattr(Capture, "keypoints", surer)
    assert ran() and not ran()


# --- what is wrong with the inputs, and the rest goes on ------------------------------------------------------------


@pytest.mark.long
def test_a_damaged_mask_and_a_damaged_scan_are_named_and_the_rest_goes_on(tmp_path, capture, solver):
    (capture / "masks" / "Cam002" / "Cam002_mask000001.png").write_bytes(b"no picture")
    (capture / "scans" / "scan_000001.ply").write_bytes(b"no scan")
    (capture / "masks" / "Cam003" / "Cam003_mask000001.png").unlink()
    record = register_capture(tmp_path / "run", inputs_of(capture))
    problems = json.loads((tmp_path / "run" / REGISTRATION).read_text())["problems"]
    assert record.manifest["numbers"]["problems"] == len(problems) == 2
    assert any("camera Cam002, frame 1: mask left out" in words for words in problems)
    assert any("frame 1: the scan is left out" in words for words in problems)
    assert set(solver.shown[0].scans) == {0} and solver.shown[0].mask("Cam003", 1) is None


def test_damaged_keypoints_of_a_camera_are_named_and_the_rest_goes_on(tmp_path, plain, solver, monkeypatch):
    def keypoints(capture, camera):
        if camera in broken:
            raise InputError(f"file {camera}.npz", expected="keypoints", received="nothing")
        return joints_in(capture, camera)

    monkeypatch.setattr(Capture, "keypoints", keypoints)
    broken = {"Cam002"}
    register_capture(tmp_path, inputs_of(plain))
    assert "Cam002" not in solver.shown[0].keypoints and "Cam001" in solver.shown[0].keypoints
    (words,) = json.loads((tmp_path / REGISTRATION).read_text())["problems"]
    assert words.startswith("camera Cam002: keypoints left out: file Cam002.npz")
    broken |= set(open_capture(plain).cameras)
    with pytest.raises(InputError, match="file Cam001"):
        register_capture(tmp_path, inputs_of(plain))


def write_other_params() -> BodyParams:
    arrays = exact().as_dict()
    return BodyParams(**{**arrays, "betas": np.ones((16, 300)) * 0.1})


def test_parameters_of_another_body_are_named(tmp_path, plain, solver):
    write_other_params().save(tmp_path / "other.npz")
    with pytest.raises(InputError, match=r"betas.*at most 20 numbers.*received 300.*--body"):
        register_capture(tmp_path / "run", inputs_of(plain, params=tmp_path / "other.npz"))
    arrays = exact().as_dict()
    arrays["body_pose"] = arrays["body_pose"][:, :60]
    np.savez(tmp_path / "joints.npz", **arrays)
    with pytest.raises(InputError, match=r"body_pose.*63"):
        register_capture(tmp_path / "run", inputs_of(plain, params=tmp_path / "joints.npz"))
    assert not (tmp_path / "run" / REGISTER_STAGE).exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames": (0, 99)}, r"--frames.*received 99"),
        ({"hold_out": ("Nobody",)}, "hold-out"),
        ({"frames": (13, 14)}, "one that is trained on"),
        ({"hold_out": tuple(f"Cam00{k}" for k in range(1, 7)) + ("Face1", "Face2")}, "not held out"),
        ({"capture": None}, "--capture, or --scan"),
        (
            {"capture": None, "scan": FIXTURE / "scans" / "scan_000000.ply", "params": None},
            "a fit, or landmarks",
        ),
    ],
)
def test_unusable_inputs_are_refused_in_words(tmp_path, solver, changes, words):
    with pytest.raises(InputError, match=words):
        register_capture(tmp_path, inputs_of(**changes))
    assert not solver.shown


def test_neither_keypoints_nor_a_fit(tmp_path, solver, monkeypatch, plain):
    monkeypatch.setattr(Capture, "keypoints", lambda self, name: None)
    with pytest.raises(InputError, match="or a fit to start from"):
        register_capture(tmp_path, inputs_of(plain, start=False, params=None))


def test_neither_cameras_nor_scans_and_keypoints_without_cameras(tmp_path, capture, solver):
    for name in ("cameras.json", "calibration.csv"):
        (capture / name).unlink()
    for name in ("rgbs", "scans", "keypoints"):
        shutil.rmtree(capture / name)
    content = json.loads((capture / "manifest.json").read_text())
    plain = {key: content[key] for key in ("fps", "label_set")}
    (capture / "capture.json").write_text(json.dumps(plain))
    with pytest.raises(InputError, match="neither cameras nor scans"):
        register_capture(tmp_path / "run", inputs_of(capture))
    (capture / "keypoints").mkdir()
    with pytest.raises(InputError, match=r"cameras for its keypoints.*cameras\.json"):
        register_capture(tmp_path / "run", inputs_of(capture))


# --- what comes after -----------------------------------------------------------------------------------------------


def build_inputs(**changes) -> BuildInputs:
    files = {"scan": FIXTURE / "scans" / "scan_000000.ply", "labels": FIXTURE / "scans" / "scan_000000_labels.npz"}
    return BuildInputs(
        **{"subject": "person", "params": None, "registers": True, "label_set": "capture", **files, **changes}
    )


@pytest.mark.long
def test_a_build_takes_the_reference_frame_of_its_registration(tmp_path, solver):
    records = build(tmp_path, build_inputs(), BuildConfig(), registration=inputs_of(), last="10_body")
    assert list(records) == ["05_register", "08_capture", "10_body"]
    taken = load_params(tmp_path / "08_capture" / "params.npz")
    np.testing.assert_array_equal(taken.body_pose, exact().frame(0).body_pose)
    again = build(tmp_path, build_inputs(), BuildConfig(), registration=inputs_of(), last="10_body")
    assert not any(record.ran for record in again.values())
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert "share of frames registered" in {check["name"] for check in metrics["checks"]}


def test_a_build_whose_reference_frame_failed_says_so(tmp_path, monkeypatch, asked, plain):
    use_solver(monkeypatch, fails=(0,))
    with pytest.raises(InputError, match=r"reference frame 0.*--frame"):
        build(tmp_path, build_inputs(), BuildConfig(), registration=inputs_of(plain), last="10_body")


def test_trainings_take_what_was_given_then_what_was_registered(tmp_path, plain, solver):
    given = tmp_path / "mine.npz"
    assert params_in_use(tmp_path, None) is None and params_in_use(tmp_path, given) == given
    register_capture(tmp_path, inputs_of(plain))
    assert params_in_use(tmp_path, None) == tmp_path / REGISTERED_PARAMS and params_in_use(tmp_path, given) == given
