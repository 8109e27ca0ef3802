"""A regression that photographs correct: it starts as it was, moves neighbours alike, and is a regression again."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.models.networks.pose_regression import PoseRegression
from avatar.training.student.learned_regression import LearnedRegression
from tests.models.test_model_file import random_regression

POINTS = 60
GROUPS = np.repeat([0, 4], POINTS // 2)
PLACES = np.random.default_rng(0).uniform(0.0, 0.3, (POINTS, 3))


@pytest.fixture
def start() -> PoseRegression:
    torch.manual_seed(0)
    return random_regression(POINTS)


def learned(start: PoseRegression, reach: float = 0.05) -> LearnedRegression:
    return LearnedRegression(start, PLACES, GROUPS, reach=reach)


def test_it_starts_as_the_regression(start):
    pose = torch.randn(3, 63, generator=torch.Generator().manual_seed(1))
    assert torch.equal(learned(start)(pose), start(pose))


def test_neighbours_of_a_group_move_along_and_those_of_another_do_not(start):
    one = learned(start)
    loss = one(torch.zeros(1, 63))[0, 3].sum()
    loss.backward()
    moved = one.moved.grad.abs().sum(1)
    near = np.linalg.norm(PLACES - PLACES[3], axis=1)
    assert moved[3] == moved.max() and (moved[POINTS // 2 :] == 0).all()
    own = np.flatnonzero(GROUPS == 0)
    order = own[np.argsort(near[own])]
    assert moved[order[1]] > moved[order[-1]]


def test_what_all_points_learn_alike_is_not_smoothed_away(start):
    one = learned(start)
    with torch.no_grad():
        one.moved.add_(0.01)
    pose = torch.zeros(1, 63)
    z = (pose.clamp(-0.5, 0.5) - start.center) @ start.rows.T
    torch.testing.assert_close(one(pose), start(pose) + 0.01 * (1.0 + z.sum()), atol=1e-6, rtol=1e-5)


def test_what_was_learned_is_a_regression(start):
    one = learned(start)
    with torch.no_grad():
        one.moved.add_(0.01 * torch.randn(one.moved.shape))
    pose = torch.randn(3, 63)
    with torch.no_grad():
        found = one.regression()
        assert isinstance(found, PoseRegression) and not any(True for _ in found.parameters())
        torch.testing.assert_close(found(pose), one(pose))
        assert (found(pose) - start(pose)).abs().max() > 1e-3


def test_a_group_of_one_point_is_its_own_neighbour(start):
    groups = np.where(np.arange(POINTS) == 7, 9, GROUPS)
    one = LearnedRegression(start, PLACES, groups, reach=0.05)
    one(torch.zeros(1, 63))[0, 7, 0].backward()
    assert one.moved.grad[7].abs().sum() > 0 and (one.moved.grad[np.arange(POINTS) != 7] == 0).all()
