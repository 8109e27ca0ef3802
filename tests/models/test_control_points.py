"""Control points: partition of unity, groups that do not mix, and reproduction at the control points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar.models.control_points import choose_control_points
from smplxpp.core.errors import InputError


def sheet(count: int = 200, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two layers a millimetre apart."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3)) * [1.0, 1.0, 0.0]
    groups = rng.integers(0, 2, count)
    return points + groups[:, None] * [0.0, 0.0, 0.001], groups


@settings(max_examples=25, deadline=None)
@given(count=st.integers(2, 60), neighbours=st.integers(1, 6), seed=st.integers(0, 5))
def test_weights_partition_unity_within_groups(count, neighbours, seed):
    points, groups = sheet(60, seed)
    control = choose_control_points(points, groups, count=count, neighbour_count=neighbours)
    np.testing.assert_allclose(control.weights.sum(1), 1.0)
    assert (control.weights >= 0).all()
    used = groups[control.vertices[control.neighbours]] == groups[:, None]
    assert used.all()
    assert len(np.unique(control.vertices)) == len(control.vertices)


def test_control_points_keep_their_own_values():
    points, groups = sheet()
    control = choose_control_points(points, groups, count=40)
    values = np.random.default_rng(1).random(len(control.vertices))
    interpolated = (values[control.neighbours] * control.weights).sum(1)
    np.testing.assert_allclose(interpolated[control.vertices], values, atol=1e-6)
    assert interpolated.min() >= values.min() and interpolated.max() <= values.max()


def test_more_control_points_follow_a_smooth_field_closer():
    points, groups = sheet(2000)
    field = np.sin(3 * points[:, 0]) + np.cos(2 * points[:, 1])
    errors = []
    for count in (20, 80, 320):
        control = choose_control_points(points, groups, count=count)
        interpolated = (field[control.vertices][control.neighbours] * control.weights).sum(1)
        errors.append(np.abs(interpolated - field).mean())
    assert errors[0] > 1.5 * errors[1] > 2.2 * errors[2]


def test_points_are_spread_and_do_not_depend_on_a_rotation():
    points, groups = sheet()
    control = choose_control_points(points, groups, count=30)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = choose_control_points(points @ turn.T + 3.0, groups, count=30)
    np.testing.assert_array_equal(np.sort(control.vertices), np.sort(turned.vertices))
    nearest = np.linalg.norm(points[control.vertices][:, None] - points[control.vertices], axis=2)
    same = groups[control.vertices][:, None] == groups[control.vertices]
    np.fill_diagonal(same, False)
    assert nearest[same].min() > 0.1


def test_refused_numbers():
    points, groups = sheet(20)
    for count in (1, 21):
        with pytest.raises(InputError, match="control points"):
            choose_control_points(points, groups, count=count)
    with pytest.raises(InputError, match="at least 1"):
        choose_control_points(points, groups, count=4, neighbour_count=0)
