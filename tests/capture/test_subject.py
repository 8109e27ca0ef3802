"""Whose keypoints are a capture's, where others are in view: one person over all cameras and frames."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.layout import BODY_25, BODY_25B
from smplxpp.capture import open_capture
from smplxpp.capture.check.without_images import missing_findings
from smplxpp.capture.keypoint_files import KeypointOptions, read_keypoints
from smplxpp.capture.keypoint_people import body_25_order
from smplxpp.core import BodyParams, Camera, InputError
from smplxpp.register.landmarks import LandmarkModel
from tests.capture.calibration_writers import Rig
from tests.capture.calibration_writers import pose2sim as write_calibration

FRAMES = 4
NAMES = tuple(name for name in BODY_25B if name is not None)
BODY = load_body()


def posed_points() -> np.ndarray:
    """(FRAMES, K, 3) points of a person who lowers her arms, feet near the ground."""
    pose = np.zeros((FRAMES, BODY.joint_count, 3))
    names = list(BODY.joint_names)
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[:, names.index(f"{side}_shoulder"), 2] = sign * np.linspace(0.2, 1.1, FRAMES)
        pose[:, names.index(f"{side}_knee"), 0] = 0.3
    still = {"betas": np.zeros((1, BODY.num_betas)), "expression": np.zeros((1, BODY.num_expressions))}
    params = BodyParams.from_full_pose(pose, transl=np.tile([0.0, 1.2, 0.0], (FRAMES, 1)), **still)
    landmarks = LandmarkModel.of(BODY, NAMES)
    assert landmarks.names == NAMES
    posed = BODY.forward(params)
    return np.stack([landmarks.points(posed.frame(f).vertices, posed.frame(f).joints) for f in range(FRAMES)])


PERSON = posed_points()
BYSTANDER = PERSON[::-1] + np.array([1.5, 0.0, -1.1])


def four_cameras() -> Rig:
    out = {}
    for k in range(4):
        angle = np.pi / 2 * k + 0.4
        eye = np.array([3.4 * np.sin(angle), 1.5, 3.4 * np.cos(angle)])
        camera = Camera.look_at(eye=eye, target=np.array([0.0, 1.0, 0.0]), fov_y_deg=60.0, width=1080, height=1920)
        out[f"cam_{k + 1:02d}"] = Camera(camera.K, camera.cam_from_world, 1080, 1920, name=f"cam_{k + 1:02d}")
    return out


def listed(points: np.ndarray, camera: Camera, score: float, order=BODY_25B, *, seed: int = 0) -> list[float]:
    """A list of OpenPose: pixel centres at whole numbers, a pixel of noise."""
    pixels = (
        camera.screen_from_world(points)[:, :2] - 0.5 + np.random.default_rng(seed).normal(0, 1.0, (len(points), 2))
    )
    rows = np.zeros((25, 3))
    for place, name in enumerate(order):
        if name is not None:
            rows[place] = [*pixels[NAMES.index(name)], score]
    if order is BODY_25:  # neck and middle of the hips, which are not among our names
        rows[1], rows[8] = rows[[2, 5]].mean(axis=0), rows[[9, 12]].mean(axis=0)
    else:
        rows[17], rows[18] = rows[[5, 6]].mean(axis=0), rows[:5].mean(axis=0)
    return rows.ravel().tolist()


def write_rig(root: Path, people: list[tuple[np.ndarray, float, tuple[int, ...]]], cameras: Rig | None = None) -> Path:
    """A rig with OpenPose's folders; `people` are points, score and the cameras that see them."""
    root.mkdir(parents=True, exist_ok=True)
    calibration = write_calibration(four_cameras(), root)
    calibration.write_text(re.sub(r"distortions = .*", "distortions = [0.0, 0.0, 0.0, 0.0]", calibration.read_text()))
    for k, camera in enumerate((cameras or four_cameras()).values()):
        folder = root / "pose" / f"cam{k + 1:02d}_json"
        folder.mkdir(parents=True)
        for frame in range(FRAMES):
            seen = [(p, score) for p, score, where in people if k in where]
            # The order of the list changes from frame to frame, as detectors' does.
            seen = seen[::-1] if frame % 2 else seen
            entries = [
                {"person_id": [-1], "pose_keypoints_2d": listed(p[frame], camera, score, seed=31 * k + frame)}
                for p, score in seen
            ]
            (folder / f"cam{k + 1:02d}.{frame:04d}.json").write_text(json.dumps({"version": 1.3, "people": entries}))
    return root


def distance_px(capture, points: np.ndarray) -> float:
    """Largest distance of the keypoints from a person's points, over cameras and frames; the nose must be seen."""
    worst = 0.0
    for name, camera in capture.cameras.items():
        found = capture.keypoints(name).select(NAMES, range(FRAMES))
        for frame in range(FRAMES):
            seen = found.confidence[frame] > 0
            assert seen.any(), (name, frame)
            true = camera.screen_from_world(points[frame])[:, :2]
            worst = max(worst, float(np.linalg.norm(found.points[frame] - true, axis=1)[seen].max()))
    return worst


ALL = (0, 1, 2, 3)


def test_a_bystander_with_higher_scores_does_not_become_the_subject(tmp_path):
    capture = open_capture(write_rig(tmp_path / "take", [(PERSON, 0.6, ALL), (BYSTANDER, 0.9, ALL)]))
    assert capture.format == "rig" and capture.frames == tuple(range(FRAMES))
    assert distance_px(capture, PERSON) < 6
    (note,) = capture.keypoint_notes()
    assert "several people in view (1 at x 0.0, z" in note and "number 1 was taken" in note
    other = open_capture(tmp_path / "take", subject=2)
    assert distance_px(other, BYSTANDER) < 6
    with pytest.raises(InputError, match=r"--subject.*1 to 2"):
        open_capture(tmp_path / "take", subject=3).keypoints("cam_01")
    # A loader's workers get the capture with what it knows.
    assert distance_px(pickle.loads(pickle.dumps(capture)), PERSON) < 6


def test_who_is_in_more_views_goes_before_who_is_near_the_middle_in_two(tmp_path):
    near = PERSON + np.array([0.0, 0.0, 0.9])
    capture = open_capture(write_rig(tmp_path / "take", [(near, 0.6, ALL), (BYSTANDER * 0.4, 0.9, (0, 1))]))
    assert distance_px(capture, near) < 6


def test_a_view_without_the_subject_stays_empty_though_a_bystander_is_in_it(tmp_path):
    write_rig(tmp_path / "take", [(PERSON, 0.6, (0, 1, 2)), (BYSTANDER, 0.9, ALL)])
    capture = open_capture(tmp_path / "take")
    shown = {name: (capture.keypoints(name).confidence > 0).any(axis=1) for name in capture.cameras}
    assert all(shown[name].all() for name in ("cam_01", "cam_02", "cam_03")) and not shown["cam_04"].any()


def test_a_camera_that_stands_elsewhere_keeps_its_only_person_for_the_triangulation_to_name(tmp_path):
    moved = four_cameras()
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]]
    third = moved["cam_03"]
    moved["cam_03"] = Camera(third.K, turn @ third.cam_from_world, 1080, 1920, name="cam_03")
    people = [(PERSON, 0.6, ALL), (BYSTANDER, 0.9, (0, 1))]
    capture = open_capture(write_rig(tmp_path / "take", people, moved))
    true = moved["cam_03"].screen_from_world(PERSON[0])[:, :2]
    found = capture.keypoints("cam_03").select(NAMES, [0])
    assert np.abs(found.points[0] - true).max() < 6 and (found.confidence[0] > 0).all()


def test_one_person_is_taken_without_a_word(tmp_path):
    capture = open_capture(write_rig(tmp_path / "take", [(PERSON, 0.6, ALL)]))
    assert distance_px(capture, PERSON) < 6 and capture.keypoint_notes() == ()
    with pytest.raises(InputError, match="one person is in view"):
        open_capture(tmp_path / "take", subject=2).keypoints("cam_01")


def test_what_was_guessed_of_a_rig_is_looked_at_and_no_fault(tmp_path):
    capture = open_capture(write_rig(tmp_path / "take", [(PERSON, 0.6, ALL)]))
    guessed = [one for one in missing_findings(capture) if one.kind == "rig-guessed"]
    assert len(guessed) == 1 and "z taken for up" in guessed[0].message and guessed[0].status == "warn"
    assert not any(one.kind == "file-other" for one in missing_findings(capture))


@pytest.mark.parametrize(("order", "name"), [(BODY_25, "openpose"), (BODY_25B, "openpose-25b")])
def test_25_points_tell_their_order_in_every_view(order, name, tmp_path):
    """Read as BODY_25, the hips of a BODY_25B are three times as wide as they are."""
    for k, camera in enumerate(four_cameras().values()):
        people = [listed(PERSON[frame], camera, 0.7, order) for frame in range(FRAMES)]
        assert body_25_order(people) == name, k
        folder = tmp_path / f"C{k}"
        folder.mkdir()
        for frame, one in enumerate(people):
            (folder / f"{frame}.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": one}]}))
        told, named = (read_keypoints(folder, KeypointOptions(format=format)) for format in ("auto", name))
        assert told.names == named.names
        np.testing.assert_array_equal(told.points, named.points)


def test_25_points_that_tell_nothing_are_asked_about(tmp_path):
    """Scattered points make a person of the same size in both orders."""
    rows = np.full((25, 3), 0.8)
    rows[:, :2] = np.random.default_rng(81).uniform(100, 300, (25, 2))
    assert body_25_order([rows]) == "unclear" and body_25_order([np.zeros(75)]) == "none"
    (tmp_path / "0.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]}))
    with pytest.raises(InputError, match="--format openpose"):
        read_keypoints(tmp_path)
    assert read_keypoints(tmp_path, KeypointOptions(format="openpose-25b")).names
