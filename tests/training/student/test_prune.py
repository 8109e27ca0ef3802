"""A student made small: the file fits, and what moves most stays."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.models.model_file import save_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import Student, StudentConfig
from avatar.training.student.prune import coefficient_std, pruned_to
from smplxpp.core.errors import InputError
from tests.dolls.dancing import gaussians, sequence, write_dance
from tests.dolls.tiny import TINY_FIELD

SHAPES = BlendShapeConfig(expression_size=2, head_shapes=8, body_shapes=20, width=8, jaw=True)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


def student(frames, **change) -> Student:
    torch.manual_seed(0)
    model = Student(
        StudentConfig(field=TINY_FIELD, blend_shapes=replace(SHAPES, **change)), frames.rig, gaussians(2000), (0,)
    )
    with torch.no_grad():
        model.blend_shapes.U.normal_().mul_(torch.linspace(0.0, 1.0, 2000)[:, None, None])
        model.blend_shapes.C.copy_(model.blend_shapes.U)
    return model


@pytest.mark.parametrize("change", [{}, {"gated": True}, {"parts": 4}])
def test_the_file_fits_and_uses_the_room(frames, tmp_path, change):
    model = student(frames, **change)
    whole = save_avatar(tmp_path / "whole", model, compact=True)
    small, keep = pruned_to(model, frames, 0.6 * whole)
    size = save_avatar(tmp_path / "small", small, compact=True)
    assert size <= 0.6 * whole < size + 20_000
    assert 0.2 < keep < 0.8 and len(small.blend_shapes.active) == round(keep * 2000)
    if not change:  # the later a Gaussian, the more it moves
        assert small.blend_shapes.active.float().mean() > 1200


def test_a_student_that_fits_is_left_alone(frames):
    model = student(frames)
    assert pruned_to(model, frames, 1e9) == (model, 1.0)


def test_no_room_at_all_is_said(frames):
    with pytest.raises(InputError, match=r"MB of Gaussians and networks"):
        pruned_to(student(frames), frames, 50_000)


def test_standard_deviations_are_over_the_training_frames(frames):
    model = student(frames)
    found = coefficient_std(model, frames)
    rows = []
    for frame in frames.train_frames:
        pose = frames.pose(frame)
        rows.append(model.blend_shapes.coefficients(pose.expression[None], pose.body_pose[None], pose.jaw[None])[0])
    stacked = torch.stack(rows).double()
    expected = (stacked - stacked.mean(0)).square().mean(0).sqrt()
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-7)
    assert found.shape == (1, 28) and found.min() >= 0 and found.max() > 0
