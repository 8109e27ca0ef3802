"""The bake's losses on the mesh: zero where student and teacher agree, and independent of units."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.losses.deformation import TAU, DisplacementLoss, semantic_labels
from avatar.models.teacher_avatar import map_frame
from avatar.rig.rig import Rig
from tests.dolls.dancing import gaussians, template

SIZE = 48


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(template())


@pytest.fixture(scope="module")
def loss(rig) -> DisplacementLoss:
    return DisplacementLoss(rig, map_frame(rig), SIZE, 0.05)


def displacements(seed: int = 0) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    return 0.01 * torch.randn(template().vertex_count, 3, generator=random)


def test_zero_when_the_mesh_moves_as_the_maps_say(loss):
    moved = displacements()
    assert float(loss(moved, loss.maps.interpolate(moved))) == 0.0
    same = torch.tensor([0.01, -0.02, 0.005])
    assert float(loss(same.expand(template().vertex_count, 3), same.expand(2, SIZE, SIZE, 3))) == pytest.approx(
        0.0, abs=1e-6
    )


def test_a_constant_difference_is_its_l1_in_units_of_the_maps(loss):
    teacher = torch.tensor([0.01, -0.02, 0.005]).expand(2, SIZE, SIZE, 3)
    value = float(loss(torch.zeros(template().vertex_count, 3), teacher))
    assert value == pytest.approx(0.035 / 0.05, rel=1e-5)


def test_the_unit_of_length_does_not_matter(rig, loss):
    other = DisplacementLoss(rig, map_frame(rig), SIZE, 50.0)
    teacher = torch.zeros(2, SIZE, SIZE, 3)
    assert float(other(1000.0 * displacements(), teacher)) == pytest.approx(float(loss(displacements(), teacher)))


def test_background_of_the_maps_does_not_count(loss):
    teacher = loss.maps.interpolate(displacements())
    elsewhere = torch.where(loss.mask[..., None], teacher, torch.full_like(teacher, 7.0))
    assert float(loss(displacements(), elsewhere)) == 0.0
    assert 0.01 < float(loss.mask.float().mean()) < 0.6


def test_gradients_reach_the_vertices_that_the_maps_show(loss):
    moved = displacements().requires_grad_()
    loss(moved, torch.zeros(2, SIZE, SIZE, 3)).backward()
    touched = moved.grad.abs().sum(-1) > 0
    dress = torch.tensor(template().cloth_mask)
    assert touched[dress].float().mean() > 0.5  # outside
    assert touched[~dress].float().mean() < touched[dress].float().mean()  # the torso is inside the dress


def test_labels_are_those_of_the_corners(rig):
    bound = gaussians(50)
    labels = semantic_labels(rig, bound)
    it, index = template(), bound.face_index.numpy()
    corners = it.semantic_colors / 255.0 + np.sin(TAU * it.vertices)
    u, v = bound.barycentric.numpy().T
    weights = np.stack([u, v, 1.0 - u - v], axis=1)
    expected = np.einsum("nk,nkc->nc", weights, corners[it.faces[index]])
    np.testing.assert_allclose(labels.numpy(), expected, atol=2e-5)


def test_waves_tell_places_apart_and_labels_materials(rig):
    bound = gaussians(200)
    flat = semantic_labels(rig, bound, tau=0.0)
    assert len(torch.unique((flat * 255).round(), dim=0)) == 2  # skin and clothes
    assert len(torch.unique((semantic_labels(rig, bound) * 255).round(), dim=0)) > 100
