"""Simulated clothes in a pose: they take the place of a model's displacements by their share, and nothing else's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from smplxpp.cloth import ClothDriver, ClothShape
from smplxpp.cloth.play import play, ways
from smplxpp.core.params import BodyParams
from tests.cloth.persons import person
from tests.cloth.test_driver import QUICK, garment, swaying
from tests.dolls.dancing import dance, gaussians, template
from tests.dolls.tiny import TINY_FIELD

SHAPE = ClothShape(
    np.array([3, 330, 331, 332, 480]),
    np.arange(15, dtype=np.float32).reshape(5, 3) / 100,
    np.array([0.0, 0.25, 0.5, 1.0, 1.0], np.float32),
)


@pytest.fixture(scope="module")
def rig():
    return Rig(template())


@pytest.fixture
def pose(rig):
    return rig.with_cloth(rig.pose(dance().frame(1)), SHAPE, time=1.5)


def test_shares_mix_the_simulations_displacements_with_the_models(rig, pose):
    own = torch.full((len(rig.vertices), 3), 0.07)
    mixed = rig.displaced(pose, own)
    share = torch.from_numpy(SHAPE.share)[:, None]
    expected = own.clone()
    expected[SHAPE.vertices] = share * torch.from_numpy(SHAPE.displacements) + (1 - share) * 0.07
    torch.testing.assert_close(mixed, expected)
    alone = rig.displaced(pose)
    torch.testing.assert_close(alone[SHAPE.vertices], share * torch.from_numpy(SHAPE.displacements))
    assert alone.abs().sum(dim=1).count_nonzero() == 4
    assert pose.time == 1.5


def test_a_motion_without_simulated_clothes_is_as_it_was(rig, pose):
    plain = rig.pose(dance().frame(1))
    own = torch.rand(len(rig.vertices), 3)
    assert plain.cloth is None and rig.displaced(plain) is None and rig.displaced(plain, own) is own
    without = pose.without_cloth()
    assert without.cloth is None and without.time == 1.5
    torch.testing.assert_close(rig.skin(without), rig.skin(plain), rtol=0, atol=0)
    assert not torch.equal(rig.skin(pose), rig.skin(plain))


def test_what_counts_as_new_keeps_its_clothes_and_loses_its_code(rig, pose):
    new = pose.as_new()
    assert new.cloth is pose.cloth and new.frame is None and new.known == 0.0


def test_gradients_reach_a_models_displacements_by_what_the_simulation_leaves(rig, pose):
    own = torch.zeros(len(rig.vertices), 3, requires_grad=True)
    rig.displaced(pose, own).sum().backward()
    left = torch.ones(len(rig.vertices), 1)
    left[SHAPE.vertices, 0] = 1 - torch.from_numpy(SHAPE.share)
    torch.testing.assert_close(own.grad, left.expand(-1, 3))


def test_a_student_wears_the_simulated_clothes_once(rig, pose):
    torch.manual_seed(0)
    student = Student(StudentConfig(field=TINY_FIELD), rig, gaussians(), (0, 1))
    with torch.no_grad():
        for value in student.field.parameters():
            value.add_(0.05 * torch.randn(value.shape))
    eyes = torch.tensor([[0.0, 0.8, 2.0]])
    posed = student(pose, eyes)
    field = student.displacements(pose)
    assert field.abs().max() > 1e-3
    expected = rig.skin(pose.without_cloth(), rig.displaced(pose, field))
    torch.testing.assert_close(posed.vertices, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(posed.vertices, rig.skin(pose, field), rtol=0, atol=1e-6)


def test_the_rig_poses_simulated_clothes_as_films_of_the_template_do():
    frames = BodyParams.concatenate([swaying(k / 30) for k in range(4)])
    own, driver = Rig(person()), ClothDriver(person(), [garment()], QUICK)
    paths = list(ways(frames, 30.0))
    for k, surface in enumerate(play(person(), [garment()], frames, fps=30.0, config=QUICK)):
        shape = driver.follow(paths[k], 1 / 30, frames.frame(k))
        moved = own.with_cloth(own.pose(frames.frame(k)), shape)
        np.testing.assert_allclose(own.skin_to_numpy(moved), surface, atol=2e-5)
