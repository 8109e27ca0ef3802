"""Triangulated keypoints: exact without noise, as far off as they say with it, and every planted fault named."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.capture.cameras import camera_rig
from smplxpp.core import Camera, InputError, Keypoints2D, matrix_from_rotvec
from smplxpp.people.fixture_person import PERSON_BETAS
from smplxpp.register.keypoint_faults import mirror_index, number_ranges
from smplxpp.register.triangulate import Triangulation, TriangulationConfig, triangulate
from smplxpp.synth.motion import Performance
from smplxpp.synth.tracker import DetectorConfig, detector_keypoints

FRAMES, SIZE = 12, 640
EXACT = DetectorConfig(pixels=1e-9, outliers=0.0, missing=0.0)


def performance(seed: int) -> np.ndarray:
    """(F, 55, 3) joints of somebody who gestures, standing on the floor."""
    body = load_body(num_betas=20)
    motion = Performance(PERSON_BETAS, body.expression_names, seconds=(FRAMES - 1) / 5, seed=seed)
    joints = body.forward(motion.at(np.arange(FRAMES) / 5)).joints
    return joints + [0.0, 0.9, 0.0]


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    return performance(1)


@pytest.fixture(scope="module")
def cameras(joints) -> dict[str, Camera]:
    """Eight on a ring, two of the face."""
    rig = camera_rig(joints.reshape(-1, 3), joints[:, 12:16].reshape(-1, 3), count=10, size=SIZE, seed=2)
    return {item.camera.name: item.camera for item in rig}


def detected(joints: np.ndarray, cameras: dict[str, Camera], config: DetectorConfig | None = None, seed: int = 0):
    return {
        name: detector_keypoints(
            joints, camera, names=SMPLX_JOINTS, frames=range(len(joints)), seed=[seed, k], config=config
        )
        for k, (name, camera) in enumerate(cameras.items())
    }


@pytest.fixture(scope="module")
def noisy(joints, cameras) -> dict[str, Keypoints2D]:
    """3 px, 5 % outliers, 10 % missing."""
    return detected(joints, cameras)


def swapped(keypoints: Keypoints2D, frames: list[int]) -> Keypoints2D:
    points, confidence, mirror = keypoints.points.copy(), keypoints.confidence.copy(), mirror_index(keypoints.names)
    points[frames], confidence[frames] = points[frames][:, mirror], confidence[frames][:, mirror]
    return replace(keypoints, points=points, confidence=confidence)


def errors(found: Triangulation, joints: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found.points - joints, axis=2)


def test_exact_sightings_give_exact_points(joints, cameras):
    found = triangulate(detected(joints, cameras, EXACT), cameras)
    assert found.names == SMPLX_JOINTS and found.frames == tuple(range(FRAMES)) and found.notes == ()
    assert errors(found, joints).max() < 1e-9


def test_noise_outliers_and_gaps_leave_millimetres_as_stated(joints, cameras, noisy):
    found = triangulate(noisy, cameras)
    assert found.notes == () and found.left_out == ()
    error = errors(found, joints)
    assert np.isfinite(error).all()
    # 3 px at about 3.4 m with 330 px a metre are 9 mm a view; seven views bring that to about 4 mm a coordinate.
    assert 1e3 * np.sqrt((error**2).mean() / 3) < 5 and error.max() < 0.05
    # What is stated as one standard deviation is one: normalised errors have unit size.
    difference = found.points - joints
    normalised = np.einsum("fki,fkij,fkj->fk", difference, np.linalg.inv(found.covariance), difference)
    assert 0.8 < np.median(normalised) / 2.366 < 1.35  # the median of chi-squared with three degrees of freedom
    body = [name for name in cameras if name.startswith("Cam")]
    assert np.mean([found.noise_px[name] for name in body]) == pytest.approx(3.0, rel=0.12)
    face = [name for name in cameras if name.startswith("Face")]
    assert np.mean([found.noise_px[name] for name in face]) == pytest.approx(3.0 * 0.75, rel=0.3)


def test_outliers_are_told_from_noise(joints, cameras, noisy):
    found = triangulate(noisy, cameras)
    exact = np.stack([detected(joints, cameras, EXACT)[name].points for name in found.cameras])
    off = np.linalg.norm(np.stack([noisy[name].points for name in found.cameras]) - exact, axis=3)
    seen = np.stack([noisy[name].confidence for name in found.cameras]) > 0
    counts = np.moveaxis(found.inliers, -1, 0)
    assert counts[seen & (off < 6)].mean() > 0.99 and counts[seen & (off > 25)].mean() < 0.02
    assert not counts[~seen].any()
    total = found.by_camera["Cam001"]
    assert total.count == seen[0].sum() and 0.9 < total.inliers / total.count < 0.97
    # Median of a Rayleigh distribution; about seven views follow the noise with 3 of their 14 numbers.
    assert total.median_px == pytest.approx(3.0 * 1.1774 * np.sqrt(11 / 14), rel=0.12)
    assert found.by_point["pelvis"].count == seen[:, :, 0].sum()


@pytest.mark.parametrize("config", [None, TriangulationConfig(most_pairs=20)])
def test_the_same_call_gives_the_same_bits(cameras, noisy, config):
    one, again = (triangulate(noisy, cameras, config=config) for _ in range(2))
    assert (one.points == again.points).all() and (one.inliers == again.inliers).all()


def test_a_view_with_left_and_right_exchanged_is_swapped_back(joints, cameras, noisy):
    wrong = {**noisy, "Cam003": swapped(noisy["Cam003"], list(range(FRAMES)))}
    found = triangulate(wrong, cameras)
    assert found.notes == ("camera Cam003: left and right are swapped in the whole view; swapped back",)
    assert (found.keypoints["Cam003"].points == noisy["Cam003"].points).all()
    np.testing.assert_allclose(found.points, triangulate(noisy, cameras).points, atol=1e-4)


def test_frames_with_left_and_right_exchanged_are_named(joints, cameras, noisy):
    """Three views at once in some frames, as where somebody turns the back to the cameras."""
    frames = {"Cam002": [4, 5, 6], "Cam004": [5, 6, 7, 8], "Cam006": [0, 6]}
    wrong = noisy | {name: swapped(noisy[name], rows) for name, rows in frames.items()}
    found = triangulate(wrong, cameras)
    assert len(found.notes) == 3
    for words, (name, rows) in zip(found.notes, frames.items(), strict=True):
        assert words.startswith(f"camera {name}: left and right are swapped in frame {number_ranges(rows)};")
    np.testing.assert_allclose(found.points, triangulate(noisy, cameras).points, atol=1e-4)


@pytest.mark.parametrize("degrees", [2.0, 1.0])
def test_a_camera_that_is_turned_is_named_with_the_angle(joints, cameras, noisy, degrees):
    axis = np.array([0.3, 0.9, 0.1]) / np.linalg.norm([0.3, 0.9, 0.1])
    pose = cameras["Cam005"].cam_from_world.copy()
    turn = matrix_from_rotvec(np.radians(degrees) * axis)
    pose[:3] = turn @ pose[:3]  # about its own centre
    off = {**cameras, "Cam005": replace(cameras["Cam005"], cam_from_world=pose)}
    found = triangulate(noisy, off)
    assert found.left_out == ("Cam005",) and "Cam005" not in found.keypoints
    said = re.fullmatch(
        r"camera Cam005: its calibration is off: .* turn by ([\d.]+) degrees to agree with the others; left out",
        found.notes[0],
    )
    assert said and float(said[1]) == pytest.approx(degrees, abs=0.21) and len(found.notes) == 1
    without = {name: one for name, one in noisy.items() if name != "Cam005"}
    np.testing.assert_allclose(found.points, triangulate(without, cameras).points, atol=2e-4)


def test_another_persons_keypoints_are_left_out(joints, cameras, noisy):
    other = detected(performance(9)[::-1] + [0.4, 0.0, -0.3], cameras, seed=5)
    found = triangulate({**noisy, "Cam004": other["Cam004"]}, cameras)
    assert found.notes == ("camera Cam004: its keypoints are of another person; left out",)
    assert found.left_out == ("Cam004",)
    assert errors(found, joints).max() < 0.05


def test_another_person_in_some_frames_is_left_out_there(joints, cameras, noisy):
    other = detected(performance(9)[::-1] + [0.4, 0.0, -0.3], cameras, seed=5)["Cam004"]
    points, confidence = noisy["Cam004"].points.copy(), noisy["Cam004"].confidence.copy()
    points[3:5], confidence[3:5] = other.points[3:5], other.confidence[3:5]
    found = triangulate({**noisy, "Cam004": replace(other, points=points, confidence=confidence)}, cameras)
    assert found.notes == ("camera Cam004, frame 3 to 4: keypoints of another person; left out",)
    assert (found.keypoints["Cam004"].confidence[3:5] == 0).all() and found.left_out == ()


def test_a_frame_in_which_the_person_leaves_the_picture_is_named(joints, cameras, noisy):
    def without(keypoints: Keypoints2D) -> Keypoints2D:
        confidence = keypoints.confidence.copy()
        confidence[[2, 7]] = 0.0
        return replace(keypoints, confidence=confidence)

    gone = {name: one if name == "Cam001" else without(one) for name, one in noisy.items()}
    found = triangulate(gone, cameras)
    assert found.notes == ("frame 2, 7: fewer than two cameras see the person; no points",)
    assert np.isnan(found.points[[2, 7]]).all() and np.isnan(found.sigma[[2, 7]]).all()
    assert np.isfinite(np.delete(found.points, [2, 7], axis=0)).all()


def test_several_faults_at_once(joints, cameras, noisy):
    pose = cameras["Cam007"].cam_from_world.copy()
    pose[:3] = matrix_from_rotvec(np.array([0.0, np.radians(2.0), 0.0])) @ pose[:3]
    off = {**cameras, "Cam007": replace(cameras["Cam007"], cam_from_world=pose)}
    other = detected(performance(9)[::-1] + [0.4, 0.0, -0.3], cameras, seed=5)["Cam004"]
    wrong = {**noisy, "Cam004": other, "Cam002": swapped(noisy["Cam002"], list(range(FRAMES)))}
    found = triangulate(wrong, off)
    assert set(found.left_out) == {"Cam004", "Cam007"} and len(found.notes) == 3
    assert "Cam002: left and right" in found.notes[0]
    assert errors(found, joints).max() < 0.06


def test_everything_mirrored_cannot_be_told(joints, cameras, noisy):
    """As the docstring says: a body has to be fitted to see it."""
    every = list(range(FRAMES))
    found = triangulate({name: swapped(one, every) for name, one in noisy.items()}, cameras)
    assert found.notes == ()
    np.testing.assert_allclose(
        found.points[:, mirror_index(found.names)], triangulate(noisy, cameras).points, atol=1e-6
    )


@pytest.mark.long
def test_what_a_detector_marks_elsewhere_in_every_view_is_no_fault(joints, cameras):
    """Detectors put a hip centimetres aside, depending on the side that they see: no camera is blamed for that, and
    those that are at fault are still found."""
    rng = np.random.default_rng(3)
    biased = {}
    for k, (name, camera) in enumerate(cameras.items()):
        marked = joints + rng.normal(0, 0.012, (1, 55, 3)) + rng.normal(0, 0.006, joints.shape)
        biased[name] = detected(marked, {name: camera}, seed=k)[name]
    assert triangulate(biased, cameras).notes == ()
    pose = cameras["Cam006"].cam_from_world.copy()
    pose[:3] = matrix_from_rotvec(np.radians([2.0, 0.0, 0.0])) @ pose[:3]
    off = {**cameras, "Cam006": replace(cameras["Cam006"], cam_from_world=pose)}
    found = triangulate({**biased, "Cam003": swapped(biased["Cam003"], [1, 2])}, off)
    assert [words.partition(";")[0] for words in found.notes] == [
        "camera Cam003: left and right are swapped in frame 1 to 2",
        "camera Cam006: its calibration is off: it would have to turn by 2.0 degrees to agree with the others",
    ]


def test_one_frame_blames_a_camera_only_for_what_contradicts_the_others(joints, cameras):
    """Of a real rig's single frame four good cameras of eleven were left out, one of them for 0.4 degrees."""
    rng = np.random.default_rng(3)
    fine = ("index", "middle", "pinky", "ring", "thumb", "eye", "jaw", "collar", "spine")
    limbs = [name for name in SMPLX_JOINTS if not any(part in name for part in fine)]
    biased = {}
    for k, (name, camera) in enumerate(cameras.items()):
        biased[name] = detected(joints + rng.normal(0, 0.012, joints.shape), {name: camera}, seed=k)[name]
    assert [triangulate(biased, cameras, names=limbs, frames=[frame]).left_out for frame in range(6)] == [()] * 6
    pose = cameras["Cam006"].cam_from_world.copy()
    pose[:3] = matrix_from_rotvec(np.radians([5.0, 0.0, 0.0])) @ pose[:3]
    off = {**cameras, "Cam006": replace(cameras["Cam006"], cam_from_world=pose)}
    assert triangulate(biased, off, names=limbs, frames=[0]).left_out == ("Cam006",)


def test_a_point_that_few_of_its_cameras_agree_on_is_not_there(joints, cameras):
    """Two of eight agree on any nonsense."""
    exact = detected(joints, cameras, EXACT)
    rng = np.random.default_rng(0)
    k = SMPLX_JOINTS.index("left_wrist")
    for name in ("Cam001", "Cam003", "Cam004", "Cam005", "Cam006", "Cam007"):
        points = exact[name].points.copy()
        points[:, k] += rng.choice([-1, 1], (FRAMES, 2)) * rng.uniform(60, 120, (FRAMES, 2))
        exact[name] = replace(exact[name], points=points)
    found = triangulate(exact, cameras)
    assert np.isnan(found.points[:, k]).mean() > 0.7
    assert errors(found, joints)[:, np.arange(55) != k].max() < 1e-6


def test_mirrored_names():
    names = ("left_hip", "right_hip", "pelvis", "coco_left_ear", "face_36", "face_45", "face_30", "face_17")
    assert mirror_index(names).tolist() == [1, 0, 2, -1, 5, 4, 6, -1]


def test_what_cannot_be_triangulated_is_refused(cameras, noisy):
    with pytest.raises(InputError, match="1 cameras"):
        triangulate({"Cam001": noisy["Cam001"]}, cameras)
    with pytest.raises(InputError, match="Cam9, not calibrated"):
        triangulate({**noisy, "Cam9": noisy["Cam001"]}, cameras)


def test_two_cameras_are_enough_for_points_but_not_to_judge(joints, cameras):
    two = {name: one for name, one in detected(joints, cameras, EXACT).items() if name in ("Cam001", "Cam003")}
    found = triangulate(two, cameras, names=("pelvis", "head"), frames=(3, 4))
    assert found.notes == () and errors(found, joints[3:5][:, [0, 15]]).max() < 1e-8
