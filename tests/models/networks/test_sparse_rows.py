"""Weighted sums of rows against a gather written out, with its gradient."""

from __future__ import annotations

import pytest
import torch

from avatar.models.networks.sparse_lookups import SparseRows

COUNT, CHANNELS = 17, 5


def matrix(points: int = 30, per_point: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    """(P, k) rows, the first of every point twice in it, and weights of both signs."""
    random = torch.Generator().manual_seed(0)
    rows = torch.randint(COUNT, (points, per_point), generator=random)
    rows[:, -1] = rows[:, 0]
    return rows, torch.randn(points, per_point, generator=random)


def table(channels: int = CHANNELS) -> torch.Tensor:
    return torch.randn(COUNT, channels, generator=torch.Generator().manual_seed(1))


def gathered(values: torch.Tensor, rows: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """`sum_j w_ij table[r_ij]` in float64."""
    return (weights.double()[..., None] * values.double()[rows]).sum(1)


@pytest.mark.parametrize(("points", "per_point"), [(30, 4), (30, 1), (3, 40), (1, 4), (1, 1)])
@pytest.mark.parametrize("channels", [1, CHANNELS])
def test_is_the_gather_with_its_gradient(points, per_point, channels):
    rows, weights = matrix(points, per_point)
    values = table(channels).requires_grad_()
    found = SparseRows(rows, weights, COUNT)(values)
    expected = gathered(values, rows, weights)
    assert found.shape == (points, channels) and found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-5)
    share = torch.randn(points, channels, generator=torch.Generator().manual_seed(2))
    (mine,) = torch.autograd.grad((found * share).sum(), values)
    (theirs,) = torch.autograd.grad((expected * share).sum(), values)
    torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-5)


def test_a_row_that_comes_twice_in_a_point_counts_with_both_weights():
    twice = SparseRows(torch.tensor([[2, 2, 5]]), torch.tensor([[0.25, 0.5, 1.0]]), COUNT)
    once = SparseRows(torch.tensor([[2, 5]]), torch.tensor([[0.75, 1.0]]), COUNT)
    results = []
    for lookup in (twice, once):
        values = table().requires_grad_()
        found = lookup(values)
        results.append((found, *torch.autograd.grad(found.square().sum(), values)))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b)


def test_rows_that_no_point_uses_have_no_gradient():
    rows, weights = matrix()
    rows = 2 * (rows // 2)
    values = table().requires_grad_()
    SparseRows(rows, weights, COUNT)(values).square().sum().backward()
    used = torch.zeros(COUNT, dtype=torch.bool)
    used[rows.flatten()] = True
    assert 0 < used.sum() < COUNT
    assert values.grad[used].abs().amax(1).min() > 0 and values.grad[~used].abs().max() == 0


def test_points_in_another_order_have_the_same_sums():
    rows, weights = matrix()
    order = torch.randperm(len(rows), generator=torch.Generator().manual_seed(2))
    shuffled = SparseRows(rows[order], weights[order], COUNT)(table())
    assert torch.equal(shuffled, SparseRows(rows, weights, COUNT)(table())[order])


def test_the_same_bits_every_time():
    rows, weights = matrix(points=2000)
    results = []
    for _ in range(2):
        values = table().requires_grad_()
        found = SparseRows(rows, weights, COUNT)(values)
        results.append((found, *torch.autograd.grad(found.sin().sum(), values)))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_in_float64_the_gradient_is_that_of_finite_differences():
    rows, weights = matrix(points=6)
    lookup = SparseRows(rows, weights, COUNT).double()
    assert lookup.weights.dtype == torch.float64 and lookup.rows.dtype == torch.int64
    values = table(2).double().requires_grad_()
    assert lookup(values).dtype == torch.float64
    torch.testing.assert_close(lookup(values), gathered(values, rows, weights), rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(lookup, (values,))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
def test_a_table_of_another_type_is_summed_in_that_of_the_weights(dtype):
    rows, weights = matrix()
    values = table().to(dtype).requires_grad_()
    found = SparseRows(rows, weights, COUNT)(values)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), gathered(values, rows, weights), rtol=1e-5, atol=1e-5)
    found.sum().backward()
    assert values.grad.dtype == dtype and values.grad.abs().sum() > 0


def test_it_follows_from_what_it_is_made_of_and_is_not_saved():
    lookup = SparseRows(*matrix(), COUNT)
    assert not lookup.state_dict() and not list(lookup.parameters())
    assert len(list(lookup.buffers())) == 6
