"""Blend shapes of Gaussians: the paper's form, and gating, parts and pruning on top of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from smplxpp.core.errors import InputError

CONFIG = BlendShapeConfig(width=8)
N = 40


def filled(config: BlendShapeConfig = CONFIG, **options) -> BlendShapes:
    torch.manual_seed(0)
    if config.parts > 1:
        options.setdefault("part", torch.arange(N) % config.parts)
    if config.gated:
        options.setdefault("head_weight", torch.linspace(0, 1, N))
    shapes = BlendShapes(config, N, **options)
    with torch.no_grad():
        shapes.U.normal_()
        shapes.C.normal_()
    return shapes


def drive(batch: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(batch, 10, generator=generator), torch.randn(batch, 63, generator=generator)


def test_published_sizes():
    shapes = BlendShapes(BlendShapeConfig(), N)
    assert shapes.U.shape == shapes.C.shape == (N, 3, 28)
    assert shapes.coefficients(*drive()).shape == (3, 1, 28)
    with torch.device("meta"):
        full = BlendShapes(BlendShapeConfig(), 270_000)
    assert full.stored_bytes() == pytest.approx(91e6, rel=0.01)


def test_start_at_zero_with_a_gradient():
    shapes = BlendShapes(CONFIG, N)
    du, dc = shapes(shapes.coefficients(*drive()))
    assert du.shape == dc.shape == (3, N, 3) and du.abs().max() == dc.abs().max() == 0
    (du + dc - 1).square().sum().backward()
    assert shapes.U.grad.abs().sum() > 0 and shapes.C.grad.abs().sum() > 0


def test_sum_written_out():
    shapes = filled()
    z = shapes.coefficients(*drive())
    du, dc = shapes(z)
    expression, pose = drive()
    torch.testing.assert_close(z[1, 0], torch.cat([shapes.head(expression[1]), shapes.body(pose[1])]))
    torch.testing.assert_close(du[1, 5], sum(z[1, 0, k] * shapes.U[5, :, k] for k in range(28)))
    torch.testing.assert_close(dc[2, 7], sum(z[2, 0, k] * shapes.C[7, :, k] for k in range(28)))


@pytest.mark.parametrize("changes", [{}, {"gated": True}, {"parts": 4}, {"gated": True, "parts": 4}])
def test_gradients_reach_every_parameter(changes):
    shapes = filled(replace(CONFIG, **changes))
    du, dc = shapes(shapes.coefficients(*drive()))
    (du.square().sum() + dc.square().sum()).backward()
    assert all(p.grad.abs().sum() > 0 for p in shapes.parameters())


def test_gate_separates_head_and_body():
    weight = torch.zeros(N)
    weight[:10] = 1.0
    shapes = filled(replace(CONFIG, gated=True), head_weight=weight)
    expression, pose = drive()
    du = shapes(shapes.coefficients(expression, pose))[0]
    other_face = shapes(shapes.coefficients(expression + 1, pose))[0]
    other_pose = shapes(shapes.coefficients(expression, pose + 1))[0]
    assert torch.equal(du[:, 10:], other_face[:, 10:]) and not torch.equal(du[:, :10], other_face[:, :10])
    assert torch.equal(du[:, :10], other_pose[:, :10]) and not torch.equal(du[:, 10:], other_pose[:, 10:])


def test_parts_have_their_own_coefficients():
    shapes = filled(replace(CONFIG, parts=4))
    z = shapes.coefficients(*drive())
    du = shapes(z)[0]
    changed = z.clone()
    changed[:, 2] += 1.0
    moved = (shapes(changed)[0] - du).abs().amax((0, 2)) > 0
    assert torch.equal(moved, torch.arange(N) % 4 == 2)
    torch.testing.assert_close(du[1, 6], shapes.U[6] @ z[1, 2], rtol=1e-4, atol=1e-5)


def test_equal_parts_are_the_plain_shapes():
    plain, local = filled(), filled(replace(CONFIG, parts=4))
    with torch.no_grad():
        local.U.copy_(plain.U)
    z = plain.coefficients(*drive())
    torch.testing.assert_close(local(z.expand(-1, 4, -1))[0], plain(z)[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("changes", [{}, {"gated": True, "parts": 4}])
def test_pruning_keeps_the_important_and_drops_the_rest(changes):
    shapes = filled(replace(CONFIG, **changes))
    with torch.no_grad():
        shapes.U[::2] *= 1e-3
        shapes.C[::2] *= 1e-3
    std = torch.ones(shapes.config.parts, 28)
    assert shapes.importance(std).sum().item() == pytest.approx(1.0, rel=1e-4)
    small = shapes.pruned(std, keep=0.5)
    assert torch.equal(small.active, torch.arange(1, N, 2))
    z = shapes.coefficients(*drive())
    before, after = shapes(z), small(small.coefficients(*drive()))
    for old, new in zip(before, after, strict=True):
        torch.testing.assert_close(new[:, 1::2], old[:, 1::2], rtol=1e-4, atol=1e-5)
        assert new[:, ::2].abs().max() == 0
    mapping = 2 * sum(p.numel() for net in (shapes.head, shapes.body) for p in net.parameters())
    assert small.stored_bytes() - mapping == (shapes.stored_bytes() - mapping) // 2 + 4 * 20
    again = small.pruned(std, keep=0.25)
    assert len(again.active) == 10 and set(again.active.tolist()) <= set(small.active.tolist())


def test_pruned_state_restores():
    small = filled().pruned(torch.ones(1, 28), keep=0.3)
    twin = BlendShapes(CONFIG, N, active=small.state_dict()["active"])
    twin.load_state_dict(small.state_dict())
    z = small.coefficients(*drive())
    assert torch.equal(twin(z)[0], small(z)[0])


def test_importance_does_not_depend_on_units():
    shapes, std = filled(), torch.rand(1, 28) + 0.1
    before = shapes.importance(std)
    with torch.no_grad():
        shapes.U *= 1000.0
    torch.testing.assert_close(shapes.importance(std), before)


def test_jaw_joins_the_expression():
    shapes = filled(replace(CONFIG, jaw=True))
    expression, pose = drive()
    closed = shapes.coefficients(expression, pose, torch.zeros(3, 3))
    opened = shapes.coefficients(expression, pose, torch.ones(3, 3))
    assert not torch.equal(closed[..., :8], opened[..., :8]) and torch.equal(closed[..., 8:], opened[..., 8:])
    with pytest.raises(InputError, match="jaw"):
        shapes.coefficients(expression, pose)
    with pytest.raises(InputError, match="jaw"):
        filled().coefficients(expression, pose, torch.zeros(3, 3))


def test_refused_input():
    expression, pose = drive()
    with pytest.raises(InputError, match="parts"):
        BlendShapes(replace(CONFIG, parts=4), N)
    with pytest.raises(InputError, match="part of the Gaussians"):
        BlendShapes(replace(CONFIG, parts=4), N, part=torch.full((N,), 4))
    with pytest.raises(InputError, match="head weights"):
        BlendShapes(CONFIG, N, head_weight=torch.zeros(N))
    with pytest.raises(InputError, match="head weight"):
        BlendShapes(replace(CONFIG, gated=True), N, head_weight=torch.full((N,), float("nan")))
    with pytest.raises(InputError, match="active"):
        BlendShapes(CONFIG, N, active=torch.tensor([3, 3]))
    with pytest.raises(InputError, match="head"):
        filled().coefficients(expression[:, :4], pose)
    with pytest.raises(InputError, match="keep"):
        filled().pruned(torch.ones(1, 28), keep=0.0)
    with pytest.raises(InputError, match="parts"):
        replace(CONFIG, parts=0)
