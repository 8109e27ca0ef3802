"""Neighbouring Gaussians that learn to move alike cost nothing, in whatever axes their triangles hold it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.gaussians.binding import world_from_local
from avatar.gaussians.frames import triangle_frames
from avatar.losses import deformation
from avatar.losses.deformation import NEIGHBOURS, Coherence, _neighbours
from tests.dolls.dancing import gaussians, sequence, varied, write_dance

WAY = torch.tensor([[0.01, 0.0], [-0.02, 0.03], [0.03, 0.01]])


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance")).rig


@pytest.fixture(scope="module")
def bound():
    return varied(gaussians())


@pytest.fixture
def start(bound):
    return 0.02 * torch.randn(len(bound), 3, 2, generator=torch.Generator().manual_seed(1))


def axes_of(rig, bound):
    return triangle_frames(rig.vertices, rig.faces).rotations[bound.face_index]


def test_a_patch_that_learns_to_move_as_one_is_free(rig, bound, start):
    penalty, random = Coherence(rig, bound, start), np.random.default_rng(0)
    assert float(penalty(start, random)) == 0.0
    together = torch.einsum("nji,jk->nik", axes_of(rig, bound), WAY)
    assert float(penalty(start + together, random)) < 1e-12
    # The same numbers in every triangle's own axes are other ways in the world.
    assert float(penalty(start + WAY, random)) > 1e-5


def test_it_is_the_mean_over_gaussians_and_their_neighbours(rig, bound, start, monkeypatch):
    monkeypatch.setattr(deformation, "SHARE", 1.0)
    learned = 0.01 * torch.randn(start.shape, generator=torch.Generator().manual_seed(0))
    penalty = Coherence(rig, bound, start)
    estimates = [float(penalty(start + learned, np.random.default_rng(seed))) for seed in range(400)]
    places = world_from_local(bound, rig.vertices, rig.faces).means.detach().double().numpy()
    part = rig.template.vertex_part[rig.template.faces[bound.face_index.numpy(), 0]]
    moved = torch.einsum("nij,njk->nik", axes_of(rig, bound), learned).double().numpy()
    squares = []
    for i in range(len(bound)):
        distance = np.where(part == part[i], np.linalg.norm(places - places[i], axis=1), np.inf)
        distance[i] = np.inf
        squares += [np.square(moved[i] - moved[j]).sum() for j in np.argsort(distance)[:NEIGHBOURS]]
    assert np.mean(estimates) == pytest.approx(np.mean(squares), rel=0.02)


def test_gradients_draw_a_gaussian_to_its_neighbours(rig, bound, start, monkeypatch):
    monkeypatch.setattr(deformation, "SHARE", 1.0)
    penalty, shapes = Coherence(rig, bound, start), start.clone()
    shapes[7, 1, 0] += 0.01
    shapes.requires_grad_(True)
    penalty(shapes, np.random.default_rng(0)).backward()
    assert shapes.grad[7, 1, 0] > 0 and not shapes.grad[..., 1].any()


def test_gradients_are_those_of_finite_differences(rig, bound, start, monkeypatch):
    monkeypatch.setattr(deformation, "SHARE", 1.0)
    few = bound.select(torch.arange(12))
    penalty = Coherence(rig, few, start[:12])
    penalty._start, penalty._own_from_other = penalty._start.double(), penalty._own_from_other.double()
    shapes = (start[:12] + torch.randn(12, 3, 2, generator=torch.Generator().manual_seed(2))).double()
    assert torch.autograd.gradcheck(lambda U: penalty(U, np.random.default_rng(3)), shapes.requires_grad_(True))


def test_parts_are_apart_and_a_lonely_gaussian_is_its_own_neighbour():
    places = np.array([[0.0, 0, 0], [1e-3, 0, 0], [2e-3, 0, 0], [0.5, 0, 0]])
    near = _neighbours(places, np.array([0, 0, 1, 0]))
    assert near[2].tolist() == [2] * NEIGHBOURS
    assert set(near[0]) == {0, 1, 3} and near[0, 0] == 1
