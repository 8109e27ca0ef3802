"""Gaussians in a mouth that stays shut learn nothing; those of one that opens do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from avatar.rig.rig import Rig
from avatar.training.engine.unseen_mouth import hold_unseen_mouth, unseen_mouth
from smplxpp.body import load_body
from smplxpp.core.params import BodyParams
from smplxpp.template.mouth import inside_of_mouth
from tests.template.test_template import template_of


class Talking:
    """Frames of a sequence, as far as mouths are concerned."""

    def __init__(self, rig: Rig, jaws: tuple[float, ...]) -> None:
        self.rig, self.train_frames = rig, tuple(range(len(jaws)))
        body = rig.template.body
        rest = BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions)
        self._poses = [replace(rest, jaw_pose=np.array([[jaw, 0.0, 0.0]])) for jaw in jaws]

    def motion(self, frame: int):
        return self.rig.motion(self._poses[frame])


@pytest.fixture(scope="module")
def rig():
    return Rig(template_of(load_body(num_betas=4, num_expressions=6), np.zeros(4)))


@pytest.fixture(scope="module")
def bound(rig):
    return sample_on_mesh(rig.template, SamplingConfig(count=12_000, head_share=0.6, hidden_density=1.0))


def test_only_the_mouth_and_only_while_it_is_shut(rig, bound):
    gaussians = LearnedGaussians(bound)
    inside = inside_of_mouth(rig.template)[rig.template.faces[bound.face_index.numpy()]].all(axis=1)
    shut, opened = (unseen_mouth(Talking(rig, jaws), gaussians).numpy() for jaws in ((0.0, 0.0), (0.0, 0.4)))
    assert inside.sum() > 50 and not (shut & ~inside).any()
    assert shut.sum() > 0.5 * inside.sum()
    assert opened.sum() < 0.7 * shut.sum() and not (opened & ~shut).any()


def test_what_is_held_gets_no_gradient(rig, bound):
    gaussians = LearnedGaussians(bound)
    shapes = BlendShapes(BlendShapeConfig(), len(bound), active=torch.arange(0, len(bound), 2))
    sequence = Talking(rig, (0.0,))
    held = unseen_mouth(sequence, gaussians)
    hold_unseen_mouth(sequence, gaussians, shapes)
    learned = [getattr(gaussians, name) for name in LEARNED]
    sum(value.square().sum() + value.sum() for value in (*learned, shapes.U, shapes.C)).backward()
    for value in learned:
        moves = value.grad.flatten(1).abs().amax(dim=1) if value.ndim > 1 else value.grad.abs()
        assert not moves[held].any() and moves[~held].any()
    for basis in (shapes.U, shapes.C):
        moves = basis.grad.flatten(1).abs().amax(dim=1)
        assert not moves[held[shapes.active]].any() and moves[~held[shapes.active]].all()
