"""Cameras that are a little off are put right; together they stay where they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.training.refinement.nuisance import CameraCorrections
from avatar.training.refinement.refine import refine_poses
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from tests.dolls.gesturing import gestures, sequence, write_gestures
from tests.training.refinement.test_refine import CONFIG


@pytest.mark.long
def test_a_camera_that_was_turned_comes_back_and_the_mean_stays(tmp_path):
    frames = sequence(write_gestures(tmp_path / "gestures"), gestures(), tmp_path)
    capture, off = frames.capture, np.eye(4)
    off[:3, :3] = matrix_from_rotvec(np.radians([0.0, 0.5, 0.0]))
    true = {name: camera.cam_from_world for name, camera in capture.recording.cameras.items()}
    cameras = dict(capture.recording.cameras)
    cameras["Ring1"] = replace(cameras["Ring1"], cam_from_world=off @ true["Ring1"])
    frames.capture = replace(capture, recording=replace(capture.recording, cameras=cameras))
    wrong = {name: frames.capture.cameras[name].cam_from_world for name in frames.train_cameras}
    found = refine_poses(frames, replace(CONFIG, cameras=True))

    def seen_apart(poses: dict[str, np.ndarray]) -> float:
        """Millimetres at the doll's chest, between where the turned camera sees it and where it is."""
        chest = np.array([0.0, 0.5, 0.0, 1.0])
        return 1e3 * float(np.linalg.norm(((poses["Ring1"] - true["Ring1"]) @ chest)[:2]))

    assert seen_apart(wrong) > 15.0 and seen_apart(found.cameras) < 0.5 * seen_apart(wrong)
    motions = [np.linalg.inv(wrong[name]) @ found.cameras[name] for name in wrong]
    assert np.abs(np.mean([rotvec_from_matrix(one[:3, :3]) for one in motions], axis=0)).max() < 1e-4


def test_corrections_begin_with_none():
    corrections = CameraCorrections(("A", "B"), np.array([0.0, 1.0, 0.0]), CONFIG)
    np.testing.assert_array_equal(corrections.matrix("B"), np.eye(4))
    corrections.step()  # without any view nothing is known
    np.testing.assert_array_equal(corrections.matrix("A"), np.eye(4))
