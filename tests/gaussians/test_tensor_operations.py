"""Rows of a tensor by index: plain indexing's values and gradients, the same bits under threads."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from avatar.gaussians.tensor_operations import gather_rows
from avatar.rendering.mesh_maps import vertex_normals


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("shape", [(7,), (5, 3), (0, 3)])
@pytest.mark.parametrize("width", [(), (4,), (2, 3)])
def test_gathers_as_indexing_does(shape, width):
    rng = torch.Generator().manual_seed(0)
    values = torch.randn(6, *width, dtype=torch.float64, generator=rng, requires_grad=True)
    index = torch.randint(0, 6, shape, generator=rng)
    found, expected = gather_rows(values, index), values[index]
    assert torch.equal(found, expected)
    outer = torch.randn(expected.shape, dtype=torch.float64, generator=rng)
    (own,), (theirs,) = (torch.autograd.grad(x, values, outer) for x in (found, expected))
    torch.testing.assert_close(own, theirs)


def test_gradients_are_the_same_bits_each_time(two_threads):
    rng = torch.Generator().manual_seed(0)
    vertices = torch.randn(300, 3, generator=rng, requires_grad=True)
    faces = torch.randint(0, 300, (40_000, 3), generator=rng)
    outer = torch.randn(300, 3, generator=rng)
    grads = [torch.autograd.grad(vertex_normals(vertices, faces), vertices, outer)[0] for _ in range(20)]
    assert all(torch.equal(grad, grads[0]) for grad in grads)
