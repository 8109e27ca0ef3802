"""Control points: partition of unity, groups that do not mix, and reproduction at the control points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar.models.networks.control_points import choose_control_points, template_control_points
from smplxpp.core.errors import InputError
from tests.dolls.dancing import template


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


def shares(groups: np.ndarray, count: int, importance: np.ndarray | None) -> np.ndarray:
    points = np.random.default_rng(0).random((len(groups), 3))
    control = choose_control_points(points, groups, count=count, importance=importance)
    assert len(control.vertices) == count
    return np.bincount(groups[control.vertices], minlength=groups.max() + 1)


@settings(max_examples=60, deadline=None)
@given(data=st.data(), sizes=st.lists(st.integers(1, 25), min_size=1, max_size=5))
def test_shares_are_exact_and_within_every_group(data, sizes):
    groups = np.repeat(np.arange(len(sizes)), sizes)
    count = data.draw(st.integers(len(sizes), len(groups)))
    weight = data.draw(st.lists(st.floats(1e-3, 1e3), min_size=len(sizes), max_size=len(sizes)))
    found = shares(groups, count, np.array(weight)[groups])
    assert found.sum() == count and (found >= 1).all() and (found <= sizes).all()


def test_importance_moves_shares():
    groups = np.repeat([0, 1], [120, 60])
    plain = shares(groups, 40, None)
    np.testing.assert_array_equal(plain, shares(groups, 40, np.full(180, 7.0)))  # alike, whatever the number
    assert abs(plain[0] - 2 * plain[1]) <= 2
    heavy = shares(groups, 40, np.where(groups == 1, 4.0, 1.0))
    assert abs(heavy[1] - 2 * heavy[0]) <= 2 and heavy.sum() == 40
    # What is too much for a group goes to the other.
    np.testing.assert_array_equal(shares(groups, 100, np.where(groups == 1, 1e6, 1.0)), [40, 60])


def test_a_templates_clothes_have_more():
    it = template()
    control = template_control_points(it, 90)
    cloth = int(it.cloth_mask[control.vertices].sum())
    wishes = 4.0 * it.cloth_mask.sum(), (~it.cloth_mask).sum()
    assert len(control.vertices) == 90 and abs(cloth - 90 * wishes[0] / sum(wishes)) <= 2
    assert (it.vertex_part[control.vertices[control.neighbours]] == it.vertex_part[:, None]).all()


def test_a_template_of_fewer_vertices_has_them_all():
    control = template_control_points(template(), 10_000)
    np.testing.assert_array_equal(np.sort(control.vertices), np.arange(template().vertex_count))


def test_refused_numbers():
    points, groups = sheet(20)
    for count in (1, 21):
        with pytest.raises(InputError, match="control points"):
            choose_control_points(points, groups, count=count)
    with pytest.raises(InputError, match="at least 1"):
        choose_control_points(points, groups, count=4, neighbour_count=0)
