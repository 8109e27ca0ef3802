"""Joints that vertices see: neighbours along the skeleton, growing with the steps."""

from __future__ import annotations

import numpy as np

from avatar.models.networks.pose_dependence import MIN_SKIN_WEIGHT, seen_joints
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
