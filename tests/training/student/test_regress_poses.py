"""Regressions from poses to surfaces: what is linear is found, what is noise is left, far joints count less."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from avatar.training.student.regress_poses import DEFAULT, fit_pose_regression

JOINTS, POINTS = 21, 40
NEAR = 3
"""Joints that carry the points; all others are four steps away."""


def _steps() -> np.ndarray:
    steps = np.full((POINTS, JOINTS), 4)
    steps[:, :NEAR] = np.arange(NEAR)
    return steps


def _moved(poses: np.ndarray, seed: int = 0) -> np.ndarray:
    """Surfaces that are linear in the angles of the joints that carry them, centimetres of motion."""
    rng = np.random.default_rng(seed)
    weights, level = 0.02 * rng.normal(size=(POINTS, 3, 3 * NEAR)), 0.01 * rng.normal(size=(POINTS, 3))
    return level + np.einsum("kxj,tj->tkx", weights, poses[:, : 3 * NEAR])


def _poses(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.4, 0.4, (count, 63))


def _said(regression, poses: np.ndarray) -> np.ndarray:
    return regression(torch.tensor(poses, dtype=torch.float32)).numpy()


PLACES = np.random.default_rng(9).uniform(0.0, 0.3, (POINTS, 3))
PARTS = np.zeros(POINTS, dtype=np.int64)


def test_what_is_linear_in_near_joints_is_found_from_few_poses():
    poses, new = _poses(40, 1), _poses(20, 2)
    regression, chosen = fit_pose_regression(poses, _moved(poses), PLACES, _steps(), PARTS)
    assert chosen[0].fade < 1.0 and chosen[0].error < 0.05 * chosen[0].mean_error
    off, whole = (np.linalg.norm(x, axis=2).mean() for x in (_said(regression, new) - _moved(new), _moved(new)))
    assert off < 0.03 * whole
    # The other joints say nothing, and few directions are left of 63.
    away = new.copy()
    away[:, 3 * NEAR :] = 0.0
    assert np.abs(_said(regression, away) - _said(regression, new)).max() < 2e-3
    assert len(regression.rows) <= 30


def test_where_poses_tell_nothing_the_mean_stands():
    poses, rng = _poses(40, 1), np.random.default_rng(5)
    noise = 0.01 * rng.normal(size=(40, POINTS, 3))
    regression, chosen = fit_pose_regression(poses, noise, PLACES, _steps(), PARTS)
    assert chosen[0].error < 1.05 * chosen[0].mean_error
    said = _said(regression, _poses(20, 2))
    assert np.abs(said - noise.mean(0)).max() < 0.01 and np.square(said - noise.mean(0)).mean() < 0.1 * 0.01**2


def test_parts_are_chosen_apart():
    poses = _poses(40, 1)
    surfaces = _moved(poses)
    parts = np.repeat([3, 7], POINTS // 2)
    noisy = np.where((parts == 7)[:, None], 0.01 * np.random.default_rng(5).normal(size=surfaces.shape), surfaces)
    _, chosen = fit_pose_regression(poses, noisy, PLACES, _steps(), parts)
    assert set(chosen) == {3, 7} and chosen[3].ridge < 0.01 * chosen[7].ridge
    assert all(one.fade in DEFAULT.fades for one in chosen.values())


def test_the_order_of_points_does_not_matter():
    poses, order = _poses(25, 1), np.random.default_rng(3).permutation(POINTS)
    surfaces, steps = _moved(poses), _steps()
    steps[::2] = steps[::2, ::-1]
    a, _ = fit_pose_regression(poses, surfaces, PLACES, steps, PARTS)
    b, _ = fit_pose_regression(poses, surfaces[:, order], PLACES[order], steps[order], PARTS)
    np.testing.assert_allclose(_said(b, poses), _said(a, poses)[:, order], atol=2e-5)


def test_few_directions_say_what_all_would():
    poses = _poses(60, 1)
    regression, _ = fit_pose_regression(poses, _moved(poses), PLACES, _steps(), PARTS)
    assert np.sqrt(np.square(_said(regression, poses) - _moved(poses)).sum(-1).mean()) < 2e-4


def test_angles_are_held_a_quarter_of_their_range_beyond_training():
    poses = _poses(30, 1)
    regression, _ = fit_pose_regression(poses, _moved(poses), PLACES, _steps(), PARTS)
    reach = np.ptp(poses, axis=0)
    np.testing.assert_allclose(regression.low.numpy(), poses.min(0) - DEFAULT.margin * reach, atol=1e-6)
    np.testing.assert_allclose(regression.high.numpy(), poses.max(0) + DEFAULT.margin * reach, atol=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_one_frame_or_two_give_a_mean_and_no_numbers_that_are_not_finite(count):
    poses = _poses(count, 1)
    regression, _ = fit_pose_regression(poses, _moved(poses), PLACES, _steps(), PARTS)
    said = _said(regression, _poses(5, 2))
    assert np.isfinite(said).all()
    if count == 1:
        np.testing.assert_allclose(said, np.broadcast_to(_moved(poses), said.shape), atol=1e-6)


def test_chance_from_point_to_point_is_smoothed_away():
    poses, new, rng = _poses(40, 1), _poses(20, 2), np.random.default_rng(6)
    wave = np.sin(10.0 * PLACES.sum(1))[None, :, None] * np.float64([1.0, 0.0, 0.0])
    surfaces, truth = (0.05 * wave * p[:, None, :3].sum(2, keepdims=True) for p in (poses, new))
    noisy = surfaces + 0.02 * rng.normal(size=surfaces.shape)
    regression, chosen = fit_pose_regression(poses, noisy, PLACES, _steps(), PARTS)
    apart = PLACES + 10.0 * np.arange(POINTS)[:, None]
    alone, of_alone = fit_pose_regression(poses, noisy, apart, _steps(), PARTS)
    assert chosen[0].reach > 0.0 and chosen[0].error < of_alone[0].error
    assert np.square(_said(regression, new) - truth).mean() < np.square(_said(alone, new) - truth).mean()


@pytest.mark.parametrize("seed", range(3))
def test_what_sways_slowly_of_its_own_is_not_taken_for_the_poses(seed):
    """With its neighbours in time at hand anything smooth foretells a left-out frame from anything else."""
    rng = np.random.default_rng(seed)

    def swaying(count: int) -> np.ndarray:
        smooth = gaussian_filter1d(rng.normal(size=(60, count)), 2.0, axis=0)
        return smooth / smooth.std(axis=0)

    poses, surfaces = 0.2 * swaying(63), 0.005 * swaying(3 * POINTS).reshape(60, POINTS, 3)
    learned, asked = slice(0, 40), slice(44, 60)
    regression, chosen = fit_pose_regression(poses[learned], surfaces[learned], PLACES, _steps(), PARTS)
    off = np.square(_said(regression, poses[asked]) - surfaces[asked]).mean()
    of_mean = np.square(surfaces[learned].mean(0) - surfaces[asked]).mean()
    assert chosen[0].error > 0.8 * chosen[0].mean_error and off < 1.15 * of_mean
