"""Poses between poses, smoothed motions, and smoothing as they come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.cloth.poses import CausalSmoother, pose_between, reference_facing_as, resampled, smoothed
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec, rotvec_from_matrix
from tests.cloth.persons import standing


def motion(count: int, *, seed: int | None = None, degrees: float = 2.0) -> BodyParams:
    """A person who walks evenly and turns a knee and themselves evenly, past half a turn; a seed shakes all of it."""
    t = np.arange(count)
    pose = np.zeros((count, 55, 3))
    pose[:, 0, 1], pose[:, 4, 0] = 0.25 * t, 0.02 * t
    transl = np.stack([0.1 * t, 0 * t, 0.05 * t], axis=1)
    if seed is not None:
        random = np.random.default_rng(seed)
        pose += np.radians(degrees) * random.normal(size=pose.shape)
        transl = transl + 0.01 * random.normal(size=transl.shape)
    return BodyParams.from_full_pose(pose, betas=np.zeros((count, 2)), expression=np.zeros((count, 2)), transl=transl)


def angles(one: BodyParams, other: BodyParams) -> np.ndarray:
    """(T, J) radians between the rotations of two motions."""
    joints = []
    for name in ("global_orient", "body_pose"):
        a, b = (matrix_from_rotvec(getattr(params, name).reshape(len(params), -1, 3)) for params in (one, other))
        joints.append(np.linalg.norm(rotvec_from_matrix(np.swapaxes(a, -1, -2) @ b), axis=-1))
    return np.concatenate(joints, axis=1)


def test_between_two_poses_lie_their_ends_and_the_shortest_turn():
    start, end = motion(20).frame(1), motion(20).frame(12)  # 2.75 rad apart: the short way
    for t, there in ((0.0, start), (1.0, end)):
        between = pose_between(start, end, t)
        assert angles(between, there).max() < 1e-6
        np.testing.assert_allclose(between.transl, there.transl, atol=1e-12)
    half = pose_between(start, end, 0.5)
    np.testing.assert_allclose(angles(start, half), 0.5 * angles(start, end), atol=1e-6)
    np.testing.assert_allclose(half.transl, 0.5 * (start.transl + end.transl))
    far = pose_between(standing(turned=3.0), standing(turned=-3.0), 0.5)
    assert np.abs(far.global_orient[0, 1]) == pytest.approx(np.pi, abs=1e-6)  # not through 0


def test_hands_of_other_kinds_are_the_ends():
    start, end = standing(), replace(standing(), left_hand_pose=np.full((1, 6), 0.3))
    np.testing.assert_array_equal(pose_between(start, end, 0.2).left_hand_pose, end.left_hand_pose)


def test_the_reference_pose_stands_and_looks_as_the_pose_does_and_stays_upright():
    reference, pose = standing(swung=0.2, turned=0.3), standing(at=(1.0, 2.0, 3.0), turned=2.0)
    facing = reference_facing_as(reference, pose)
    np.testing.assert_array_equal(facing.transl, pose.transl)
    own, was, wanted = (matrix_from_rotvec(p.global_orient)[0] for p in (facing, reference, pose))
    ahead, target = own @ [0, 0, 1], wanted @ [0, 0, 1]
    assert np.arctan2(ahead[0], ahead[2]) == pytest.approx(np.arctan2(target[0], target[2]))
    np.testing.assert_allclose(own[1], was[1], atol=1e-9)  # turned about the vertical alone
    assert angles(facing, reference)[0, 1:].max() == 0


@pytest.mark.parametrize("radius", [0.3, 1.0, 2.5])
def test_smoothing_keeps_even_motion_and_both_ends(radius):
    even = motion(30)
    soft = smoothed(even, radius=radius)
    assert angles(soft, even).max() < 1e-6
    np.testing.assert_allclose(soft.transl, even.transl, atol=1e-9)
    shaken = motion(30, seed=1)
    soft = smoothed(shaken, radius=radius)
    for end in (0, -1):
        np.testing.assert_allclose(soft.transl[end], shaken.transl[end])
        assert angles(soft.select([end]), shaken.select([end])).max() < 1e-6


def test_smoothing_takes_noise_away_by_as_much_as_its_weights_say():
    shaken, even = motion(200, seed=2), motion(200)
    middle = slice(20, 180)
    before = np.std((shaken.transl - even.transl)[middle])
    after = np.std((smoothed(shaken, radius=2.0).transl - even.transl)[middle])
    # Of independent noise a Gaussian of standard deviation r leaves 1 / sqrt(2 r sqrt(pi)).
    assert after / before == pytest.approx(1 / np.sqrt(4.0 * np.sqrt(np.pi)), rel=0.2)
    turned = angles(smoothed(shaken, radius=2.0), even)[middle].mean() / angles(shaken, even)[middle].mean()
    assert turned == pytest.approx(after / before, rel=0.25)


def test_smoothing_does_not_see_where_motion_takes_place():
    shaken = motion(30, seed=3)
    turn = matrix_from_rotvec(np.array([0.3, 2.0, 0.1]))
    moved = replace(
        shaken,
        global_orient=rotvec_from_matrix(turn @ matrix_from_rotvec(shaken.global_orient)),
        transl=shaken.transl @ turn.T + [1, 2, 3],
    )
    one, other = smoothed(shaken, radius=1.5), smoothed(moved, radius=1.5)
    np.testing.assert_allclose(other.transl, one.transl @ turn.T + [1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(
        matrix_from_rotvec(other.global_orient), turn @ matrix_from_rotvec(one.global_orient), atol=1e-9
    )


def test_no_smoothing_and_single_frames_change_nothing_and_less_than_none_is_refused():
    shaken = motion(5, seed=1)
    assert smoothed(shaken, radius=0.0) is shaken
    assert smoothed(shaken.frame(0), radius=3.0).transl.tolist() == shaken.transl[:1].tolist()
    for radius in (-1.0, float("nan")):
        with pytest.raises(InputError, match="smoothing"):
            smoothed(shaken, radius=radius)


def come(params: BodyParams, fps: float, **options) -> BodyParams:
    """A motion smoothed as it comes."""
    smoother = CausalSmoother(**options)
    return BodyParams.concatenate([smoother(params.frame(k), 1 / fps) for k in range(len(params))])


def test_what_is_smoothed_as_it_comes_lags_by_its_time_constant_and_shakes_less():
    t = np.arange(120) / 60.0
    walk = replace(motion(120), transl=np.stack([0.4 * t, 0 * t, 0 * t], axis=1))
    soft = come(walk, 60.0, cutoff=2.0, speed_gain=0.0)
    lag = (walk.transl - soft.transl)[-1, 0] / 0.4
    assert lag == pytest.approx(1 / (2 * np.pi * 2.0), rel=0.02)  # of an exponential filter
    quick = come(walk, 60.0, cutoff=2.0, speed_gain=20.0)
    assert (walk.transl - quick.transl)[-1, 0] / 0.4 < 0.5 * lag  # fast motion is not held back
    still = replace(motion(120, seed=1), transl=0.002 * np.random.default_rng(1).normal(size=(120, 3)))
    soft = come(still, 60.0, cutoff=2.0, speed_gain=2.0)
    assert np.std(np.diff(soft.transl, axis=0)) < 0.35 * np.std(np.diff(still.transl, axis=0))


def test_a_smoother_starts_with_the_first_pose_and_after_a_restart_again():
    shaken, smoother = motion(3, seed=1), CausalSmoother()
    assert smoother(shaken.frame(0), 1 / 30).transl.tolist() == shaken.transl[:1].tolist()
    assert smoother(shaken.frame(1), 1 / 30).transl.tolist() != shaken.transl[1:2].tolist()
    smoother.restart()
    assert smoother(shaken.frame(2), 1 / 30).transl.tolist() == shaken.transl[2:].tolist()


def finer(params: BodyParams, times: int) -> BodyParams:
    """The motion with `times` as many steps."""
    count = len(params)
    return resampled(params, np.arange(float(count)), np.arange((count - 1) * times + 1) / times)


@pytest.mark.parametrize("times", [2, 5])
def test_poses_in_between_pass_through_those_given_and_go_evenly_where_they_do(times):
    for params in (motion(8), motion(8, seed=1, degrees=20.0)):
        fine = finer(params, times)
        assert len(fine) == 7 * times + 1
        assert angles(fine.select(slice(None, None, times)), params).max() < 1e-6
        np.testing.assert_allclose(fine.transl[::times], params.transl, atol=1e-12)
        # No jump: at an end of a step poses lie as near to each other as within it.
        steps = np.linalg.norm(np.diff(fine.transl, axis=0), axis=1)
        assert steps.max() < 4 * np.median(steps) + 1e-9
    even = finer(motion(8), times)
    np.testing.assert_allclose(
        np.diff(even.transl, axis=0), 1 / times * np.tile([0.1, 0, 0.05], (7 * times, 1)), atol=1e-9
    )
    turns = angles(even.select(slice(1, None)), even.select(slice(0, -1)))
    np.testing.assert_allclose(turns[:, 0], 0.25 / times, atol=1e-6)


def test_poses_in_between_of_uneven_times_go_evenly_where_the_motion_does():
    kept = np.array([0, 1, 3, 4, 6, 9])
    found = resampled(motion(10).select(kept), 0.1 * kept, 0.1 * np.arange(10))
    np.testing.assert_allclose(found.transl, motion(10).transl, atol=1e-9)
    assert angles(found, motion(10)).max() < 1e-6


def test_a_single_pose_stays_and_times_that_cannot_be_are_refused():
    shaken = motion(5, seed=1)
    alone = resampled(shaken.frame(0), np.zeros(1), np.zeros(3))
    np.testing.assert_array_equal(alone.transl, np.repeat(shaken.transl[:1], 3, axis=0))
    for times in (np.array([0.0, 1.0, 1.0, 2.0, 3.0]), np.arange(4.0), np.full(5, np.nan)):
        with pytest.raises(InputError, match="times of a motion"):
            resampled(shaken, times, np.zeros(1))
    for wanted in (-0.1, 4.1, np.nan):
        with pytest.raises(InputError, match="poses in between"):
            resampled(shaken, np.arange(5.0), np.array([wanted]))


def test_poses_in_between_are_near_the_curve_that_was_sampled():
    t = np.arange(12) / 10.0

    def curve(times: np.ndarray) -> BodyParams:
        pose = np.zeros((len(times), 55, 3))
        pose[:, 4, 0], pose[:, 0, 1] = np.sin(2 * times), 0.5 * np.sin(3 * times)
        transl = np.stack([0.2 * np.sin(3 * times), 0 * times, 0 * times], axis=1)
        count = len(times)
        return BodyParams.from_full_pose(
            pose, betas=np.zeros((count, 2)), expression=np.zeros((count, 2)), transl=transl
        )

    fine, truth = finer(curve(t), 4), curve(np.arange(45) / 40.0)
    inner = slice(4, -4)
    assert np.abs(fine.transl - truth.transl)[inner].max() < 0.001
    assert angles(fine, truth)[inner].max() < np.radians(0.4)
