"""Motions at another rate and within a range: what comes between poses, and what is held back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.runtime import load_bundle
from avatar.runtime.skeleton import pose_range, resampled
from smplxpp.body.retarget import MARGIN
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec
from tests.dolls.dancing import dance
from tests.runtime.bundles import student, write


def waving(fps: float, seconds: float = 1.0) -> BodyParams:
    """An elbow that bends and a step to the side, smooth in time."""
    t = np.arange(round(fps * seconds) + 1) / fps
    pose = np.zeros((len(t), 55, 3))
    pose[:, 18, 1], pose[:, 0, 1] = 1.2 * np.sin(2.0 * np.pi * t), 2.6 + 0.9 * t
    still = {"betas": np.zeros((len(t), 2)), "expression": np.zeros((len(t), 2))}
    return BodyParams.from_full_pose(pose, transl=np.stack([t, 0 * t, t * t], axis=1), fps=fps, **still)


def rotations(params: BodyParams) -> np.ndarray:
    return matrix_from_rotvec(params.full_pose)


def apart(a: BodyParams, b: BodyParams) -> float:
    """The largest angle between the joints of two motions, degrees."""
    trace = np.einsum("tjik,tjik->tj", rotations(a), rotations(b))
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max())


@pytest.mark.parametrize("fps", [90.0, 60.0, 20.0, 7.0])
def test_a_rate_is_kept_and_poses_given_are_met(fps):
    slow = waving(20.0)
    out = resampled(slow, fps)
    assert out.fps == fps and len(out) == int(fps) + 1
    if fps % 20.0 == 0.0:
        assert apart(out.select(slice(None, None, int(fps / 20))), slow) < 1e-4


def test_between_poses_it_is_near_the_truth():
    """20 frames a second of an arm that swings at 7 radians a second, seen at 60."""
    out, truth = resampled(waving(20.0), 60.0), waving(60.0)
    assert 0.05 < apart(out, truth) < 1.0  # degrees
    assert np.abs(out.transl - truth.transl).max() < 1e-3


def test_other_vectors_of_the_same_rotations_change_nothing():
    slow = waving(20.0)
    theta = np.array(slow.global_orient)
    angle = np.linalg.norm(theta, axis=1, keepdims=True)
    flipped = np.where(np.arange(len(theta))[:, None] % 2 == 1, theta * (1 - 2 * np.pi / angle), theta)
    out = resampled(replace(slow, global_orient=flipped), 90.0)
    assert apart(out, resampled(slow, 90.0)) < 1e-4
    steps = np.einsum("tik,tik->t", rotations(out)[1:, 0], rotations(out)[:-1, 0])
    assert np.degrees(np.arccos(np.clip((steps - 1) / 2, -1, 1))).max() < 1.0


def test_rates_that_are_none_are_refused():
    for fps in (0.0, -3.0, float("nan")):
        with pytest.raises(InputError, match="frames a second"):
            resampled(waving(20.0), fps)
    with pytest.raises(InputError, match="of the motion"):
        resampled(replace(waving(20.0), fps=None), 90.0)
    assert len(resampled(waving(20.0).frame(0), 90.0, source_fps=20.0)) == 1


def test_poses_are_held_within_what_training_saw(tmp_path):
    write(tmp_path / "a.avatar", student("whole"))
    known = dance().select(range(4))
    limits = pose_range(load_bundle(tmp_path / "a.avatar"))
    assert not limits.outside(known).any()
    np.testing.assert_array_equal(limits.clamped(known).body_pose, known.body_pose)
    far = replace(known, body_pose=known.body_pose + 1.0)
    assert limits.outside(far).all()
    held = limits.clamped(far)
    angle = np.linalg.norm(limits._from_middle(held), axis=2)
    np.testing.assert_allclose(angle, np.broadcast_to(limits.reach, angle.shape), atol=1e-6)
    assert (limits.reach >= MARGIN).all()
    write(tmp_path / "b.avatar", student("student"))
    assert pose_range(load_bundle(tmp_path / "b.avatar")) is None
