"""The StyleUNet as a whole: shapes, what depends on what, gradients, and refused sizes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.models.networks.styleunet import Head, StyleUNet, StyleUNetConfig
from smplxpp.core.errors import InputError

SMALL = StyleUNetConfig(
    in_channels=6,
    heads=(Head(4), Head(3, sees_view=True)),
    in_size=32,
    out_size=64,
    bottleneck=4,
    channel_base=128,
    channel_max=8,
    style_size=8,
)


@pytest.fixture
def network():
    torch.manual_seed(0)
    return StyleUNet(SMALL)


def test_shapes_by_sizes():
    for in_size, out_size, bottleneck in ((32, 64, 4), (16, 64, 4), (64, 32, 4), (32, 32, 8 // 2), (16, 32, 4)):
        config = replace(SMALL, in_size=in_size, out_size=out_size, bottleneck=bottleneck)
        first, second = StyleUNet(config)(torch.randn(2, 6, in_size, in_size), torch.randn(2, 2, in_size, in_size))
        assert first.shape == (2, 2, out_size, out_size, 4) and second.shape == (2, 2, out_size, out_size, 3)


def test_gradients_reach_every_parameter(network):
    maps = network(torch.randn(2, 6, 32, 32), torch.randn(2, 2, 32, 32))
    sum(m.square().mean() for m in maps).backward()
    without = [n for n, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert without == []


def test_zero_output_is_zero_and_learns(network):
    zero = StyleUNet(replace(SMALL, zero_output=True))
    image, view = torch.randn(1, 6, 32, 32), torch.randn(1, 2, 32, 32)
    assert max(m.abs().max().item() for m in zero(image, view)) == 0.0
    for _ in range(2):
        zero.zero_grad()
        sum((m - 1).square().mean() for m in zero(image, view)).backward()
        with torch.no_grad():
            for parameter in zero.parameters():
                parameter -= 1e-2 * parameter.grad
    # After one step the output weights are no longer zero, so the second reaches what lies behind them.
    assert zero.encoder.first.weight.grad.abs().sum() > 0
    assert max(m.abs().max().item() for m in network(image, view)) > 0.0


def test_sides_have_decoders_of_their_own(network):
    (front_and_back, _) = network(torch.randn(1, 6, 32, 32))
    front_and_back[:, 0].sum().backward()
    front, back = network.decoders
    assert all(p.grad is None or p.grad.abs().max() == 0 for p in back.parameters())
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in front.parameters())


def test_view_changes_only_the_head_that_sees_it_and_only_its_side(network):
    image, view = torch.randn(1, 6, 32, 32), torch.randn(1, 2, 32, 32)
    blind, seeing = network(image, view)
    other = view.clone()
    other[:, 1] = -other[:, 1]
    blind_again, seeing_again = network(image, other)
    assert torch.equal(blind, blind_again)
    assert torch.equal(seeing[:, 0], seeing_again[:, 0])
    assert not torch.equal(seeing[:, 1], seeing_again[:, 1])


def test_views_of_one_pose_equal_single_views(network):
    image, views = torch.randn(1, 6, 32, 32), torch.randn(3, 2, 32, 32)
    blind, seeing = network(image, views)
    assert len(blind) == 1 and len(seeing) == 3
    for view, seen in zip(views, seeing, strict=True):
        torch.testing.assert_close(network(image, view[None])[1][0], seen, rtol=1e-4, atol=1e-5)


def test_batch_is_many_single_poses(network):
    images = torch.randn(3, 6, 32, 32)
    together = network(images)[0]
    for image, maps in zip(images, together, strict=True):
        torch.testing.assert_close(network(image[None])[0][0], maps, rtol=1e-4, atol=1e-5)


def test_same_seed_same_network_and_state_restores(network):
    torch.manual_seed(0)
    twin = StyleUNet(SMALL)
    image = torch.randn(1, 6, 32, 32)
    assert torch.equal(network(image)[0], twin(image)[0])
    torch.manual_seed(5)
    other = StyleUNet(SMALL)
    with torch.no_grad():
        network.decoders[0].coarse[0].up.noise_strength.fill_(1.0)
    # The noise images are part of the state: without them a checkpoint would draw other ones.
    other.load_state_dict(network.state_dict())
    assert torch.equal(network(image)[0], other(image)[0])


def test_published_channels():
    config = StyleUNetConfig()
    assert [config.channels(side) for side in (8, 16, 32, 64, 128, 256, 512)] == [512, 512, 512, 512, 256, 128, 64]


@pytest.mark.parametrize(
    "changes",
    [
        {"in_size": 48},
        {"out_size": 0},
        {"bottleneck": 3},
        {"in_size": 8},
        {"out_size": 16},
        {"channel_base": 8},
        {"channel_max": 0},
        {"style_size": 0},
        {"style_layers": 0},
        {"in_channels": 0},
        {"heads": ()},
        {"heads": (Head(0),)},
    ],
)
def test_refused_sizes(changes):
    with pytest.raises(InputError, match="StyleUNet"):
        replace(SMALL, **changes)
