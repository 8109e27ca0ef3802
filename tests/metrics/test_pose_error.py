"""Errors of poses against closed forms: known shifts, known angles, and masks of vertices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smplxpp.body import load_body
from smplxpp.core import BodyParams, InputError
from smplxpp.metrics import PoseError, mean_pose_error, pose_error


@pytest.fixture(scope="module")
def body():
    return load_body(num_betas=3, num_expressions=2)


def posed(frames: int = 3) -> BodyParams:
    rng = np.random.default_rng(0)
    rest = BodyParams.rest(betas=np.array([0.5, -0.3, 0.2]), expressions=2)
    drawn = {name: 0.3 * rng.normal(size=(frames, 3 * n)) for name, n in (("body_pose", 21), ("global_orient", 1))}
    return replace(rest, **drawn, **{n: np.repeat(getattr(rest, n), frames, 0) for n in ("transl", "betas")})


def half(body) -> np.ndarray:
    return np.arange(body.vertex_count) < body.vertex_count // 3


def test_a_shift_moves_everything_by_its_length_and_turns_nothing(body):
    exact = posed()
    moved = replace(exact, transl=exact.transl + [0.003, 0.0, 0.004])
    error = pose_error(moved, exact, body, half(body))
    assert error.frames == 3 and error.degrees == pytest.approx(0.0, abs=1e-9)
    for value in (error.body_mm, error.bare_mm, error.covered_mm, error.joints_mm):
        assert value == pytest.approx(5.0, rel=1e-9)


def test_angles_of_local_rotations_are_averaged_over_joints(body):
    """Every joint of the body turned by 1.5 degrees, after its own rotation: the mean is 21 of 55 joints' worth."""
    exact, rng = posed(), np.random.default_rng(1)
    axes = rng.normal(size=(3, 21, 3))
    turn = np.radians(1.5) * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    vectors = (
        Rotation.from_rotvec(exact.body_pose.reshape(-1, 3).copy()) * Rotation.from_rotvec(turn.reshape(-1, 3))
    ).as_rotvec()
    error = pose_error(replace(exact, body_pose=vectors.reshape(3, 63)), exact, body, half(body))
    assert error.degrees == pytest.approx(1.5 * 21 / 55, rel=1e-6)
    assert error.joints_mm > 1.0


def test_a_whole_turn_apart_is_no_error_and_half_a_turn_is_180_degrees(body):
    exact = posed(1)
    axis = exact.body_pose[:, :3] / np.linalg.norm(exact.body_pose[:, :3])
    again = exact.body_pose.copy()
    again[:, :3] += 2.0 * np.pi * axis
    assert pose_error(replace(exact, body_pose=again), exact, body, half(body)).degrees == pytest.approx(0.0, abs=1e-6)
    opposite = exact.body_pose.copy()
    opposite[:, :3] += np.pi * axis
    found = pose_error(replace(exact, body_pose=opposite), exact, body, half(body))
    assert found.degrees == pytest.approx(180.0 / 55, rel=1e-6)


def test_masks_tell_bare_from_covered(body):
    exact = posed(1)
    jaw = replace(exact, jaw_pose=np.array([[0.2, 0.0, 0.0]]))
    way = np.linalg.norm(body.forward(jaw).vertices - body.forward(exact).vertices, axis=-1)[0]
    moved = way > 0
    error = pose_error(jaw, exact, body, moved)
    assert error.bare_mm == 0.0 and error.covered_mm == pytest.approx(1e3 * way[moved].mean())
    assert error.body_mm == pytest.approx(1e3 * way.mean())
    assert np.isnan(pose_error(jaw, exact, body, np.ones(body.vertex_count, bool)).bare_mm)


def test_another_shape_and_hands_as_components_count(body):
    exact = posed(1)
    taller = replace(exact, betas=np.array([[1.5]]))
    error = pose_error(taller, exact, body, half(body))
    assert error.degrees == pytest.approx(0.0, abs=1e-6) and error.body_mm > 1.0 and error.joints_mm > 0.0


def test_means_count_frames():
    one, two = PoseError(1, 1.0, 2.0, 3.0, 4.0, 5.0), PoseError(3, 5.0, 6.0, 7.0, 8.0, 9.0)
    assert mean_pose_error([one, two]) == PoseError(4, 4.0, 5.0, 6.0, 7.0, 8.0)


def test_what_cannot_be_compared_is_refused(body):
    with pytest.raises(InputError, match="2 frames"):
        pose_error(posed(3), posed(2), body, half(body))
    with pytest.raises(InputError, match="covered vertices"):
        pose_error(posed(1), posed(1), body, np.ones(5, bool))
    with pytest.raises(InputError, match="at least one frame"):
        mean_pose_error([])
