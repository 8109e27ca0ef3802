"""Dependence on the pose: joints that vertices see grow with the steps; shapes of training poses do not extrapolate."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.models.networks.pose_dependence import BODY_JOINTS, MIN_SKIN_WEIGHT, PoseGate, seen_joints
from tests.dolls.dancing import template


def test_no_steps_are_the_joints_that_carry_a_vertex():
    doll = template()
    np.testing.assert_array_equal(seen_joints(doll, 0), (doll.weights.dense() > MIN_SKIN_WEIGHT)[:, 1:22])


def test_a_step_adds_parents_and_children_alone():
    doll = template()
    for joint in range(1, 22):
        on = doll.weights.dense()[:, joint] > 0.99
        if not on.any():
            continue
        near = {joint, int(doll.body.parents[joint]), *np.flatnonzero(doll.body.parents == joint).tolist()}
        expected = [other in near for other in range(1, 22)]
        np.testing.assert_array_equal(seen_joints(doll, 1)[on], np.broadcast_to(expected, (on.sum(), 21)))


def test_more_steps_see_more_until_all_is_seen():
    doll = template()
    before = seen_joints(doll, 0)
    for steps in range(1, 12):
        now = seen_joints(doll, steps)
        assert (now >= before).all()
        before = now
    assert before.all()


@pytest.mark.parametrize("step", [0.11, 0.3])
def test_a_gate_is_open_between_frames_and_closed_a_step_after_the_last(step):
    """Poses of an arm that turns by `step` radians a frame."""

    def arm(frames: float) -> torch.Tensor:
        return torch.eye(3 * BODY_JOINTS)[40] * frames * step

    gate = PoseGate(torch.stack([arm(k) for k in range(6)]))
    found = [float(gate(arm(at))) for at in (2.0, 2.25, 2.5, 5.5, 6.0, 7.0)]
    assert found == pytest.approx([1.0, 1.0, np.exp(-0.125), np.exp(-0.125), np.exp(-2.0), np.exp(-12.5)], rel=1e-3)


def test_a_gate_of_one_pose_or_of_copies_is_open_about_it():
    pose = torch.full((3 * BODY_JOINTS,), 0.1)
    for poses in (pose[None], pose.repeat(3, 1)):
        gate = PoseGate(poses)
        assert float(gate(pose)) == 1.0 and float(gate(pose + 1.0)) < 1e-6
