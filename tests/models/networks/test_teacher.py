"""The teacher: presets, inputs, and residuals in the frames of the triangles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from avatar.models.networks.sparse_lookups import MapSampler
from avatar.models.networks.teacher import (
    NETWORK_PRESETS,
    Residuals,
    Teacher,
    TeacherConfig,
    local_offsets,
    network_preset,
)
from avatar.rendering.mesh_maps import MapFrame
from smplxpp.core.errors import InputError

TINY = TeacherConfig(
    in_size=16, out_size=32, bottleneck=4, channel_base=64, channel_max=8, style_size=4, style_layers=1
)
DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "networks.md"
SMALL = replace(TINY, bottleneck=2, in_size=32, out_size=64, position_size=16)
"""With a small network for the position."""


def inputs(poses: int = 1, views: int | None = None, size: int = 16):
    generator = torch.Generator().manual_seed(1)
    shape = (poses, 2, size, size)
    positions, semantics = (torch.rand(*shape, 3, generator=generator) for _ in range(2))
    return positions, semantics, None if views is None else torch.rand(views, *shape[1:], generator=generator)


@pytest.mark.parametrize("name", NETWORK_PRESETS)
def test_documented_sizes_of_the_presets(name):
    """The first table of `docs/networks.md`."""
    config = network_preset(name).teacher
    with torch.device("meta"):
        count = sum(p.numel() for p in Teacher(config).parameters())
    row = next(line for line in DOCUMENT.read_text().splitlines() if line.startswith(f"| `{name}` |"))
    _, sizes, networks, parameters, *_ = (cell.strip() for cell in row.strip("|").split("|"))
    position = f"{config.position_size or config.out_size}"
    assert sizes == f"{config.in_size}, {config.out_size}" and parameters == f"{count:,}"
    assert networks == {"separate": "three", "shared": f"two, the position at {position}"}[config.networks]


@pytest.mark.parametrize("networks", ["separate", "shared"])
@pytest.mark.parametrize("semantics", ["sum", "concatenate"])
def test_maps_and_gradients(networks, semantics):
    torch.manual_seed(0)
    teacher = Teacher(replace(TINY, networks=networks, semantics=semantics))
    maps = teacher(*inputs(2, 2))
    assert maps.shape.shape == (2, 2, 32, 32, 10) and maps.colour.shape == (2, 2, 32, 32, 3)
    (maps.shape.square().mean() + maps.colour.square().mean()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in teacher.parameters())


@pytest.mark.parametrize("name", ["cpu", "demo"])
def test_lean_presets_start_from_the_reference_frame(name):
    config = network_preset(name).teacher
    maps = Teacher(config)(*inputs(1, 1, config.in_size))
    assert maps.shape.shape == (1, 2, config.out_size, config.out_size, 10)
    assert maps.shape.abs().max() == 0 and maps.colour.abs().max() == 0


@pytest.mark.parametrize("networks", ["separate", "shared"])
def test_the_positions_own_network_gives_maps_of_the_same_size(networks):
    torch.manual_seed(0)
    teacher = Teacher(replace(SMALL, networks=networks))
    own = teacher.networks["position"].config
    assert (own.in_size, own.out_size) == (8, 16)
    maps = teacher(*inputs(2, 2, 32))
    assert maps.shape.shape == (2, 2, 64, 64, 10) and maps.colour.shape == (2, 2, 64, 64, 3)
    (maps.shape.square().mean() + maps.colour.square().mean()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in teacher.parameters())


@pytest.mark.parametrize(
    "changes", [{}, {"networks": "shared"}, {"position_size": 0}, {"position_size": 0, "networks": "shared"}]
)
def test_the_position_alone_is_that_of_all_residuals(changes):
    torch.manual_seed(0)
    teacher = Teacher(replace(SMALL, **changes))
    positions, semantics, views = inputs(2, 2, 32)
    alone = teacher.positions(positions, semantics[:1])
    torch.testing.assert_close(alone, teacher(positions, semantics[:1], views).shape[..., :3])


def test_its_own_network_is_one_of_half_the_sizes():
    smaller = replace(SMALL, position_size=0, in_size=8, out_size=16, channel_base=32, channel_max=4)
    own, without = SMALL.network_configs(), replace(SMALL, position_size=0).network_configs()
    assert own.pop("position") == smaller.network_configs()["position"]
    assert own == {name: without[name] for name in ("colour", "other")}


def test_enlarged_maps_have_the_small_ones_values_between_their_pixels():
    torch.manual_seed(0)
    large = Teacher(SMALL)
    positions, semantics, _ = inputs(1, None, 32)
    image = (positions + semantics).permute(0, 1, 4, 2, 3).flatten(1, 2)
    (known,) = large.networks["position"](torch.nn.functional.avg_pool2d(image, 4))
    found = large.positions(positions, semantics)
    assert known.shape == (1, 2, 16, 16, 3) and found.shape == (1, 2, 64, 64, 3)
    # The maps cover one square: a place has the same value in both, whatever their pixels are.
    frame, points = MapFrame((0.0, 0.0, 0.0)), 1.8 * torch.rand(200, 3) - 0.9
    pixels = (frame.pixels_from_canonical(points, 16) - 0.5).round() + 0.5
    centres = torch.stack([pixels[:, 0] / 8 - 1, 1 - pixels[:, 1] / 8, points[:, 2]], dim=1)
    front = points[:, 2] >= 0
    in_small, in_large = (MapSampler(frame, maps.shape[2], centres, front)(maps) for maps in (known, found))
    spread = known.std()
    assert (in_large - in_small).abs().mean() < 0.25 * spread
    assert bool((found.amax((2, 3)) <= known.amax((2, 3)) + 1e-6).all())
    assert bool((found.amin((2, 3)) >= known.amin((2, 3)) - 1e-6).all())


def test_shape_does_not_depend_on_the_view():
    for networks in ("separate", "shared"):
        torch.manual_seed(0)
        teacher = Teacher(replace(TINY, networks=networks))
        positions, semantics, views = inputs(1, 3)
        maps = teacher(positions, semantics, views)
        assert len(maps.shape) == 1 and len(maps.colour) == 3
        assert torch.equal(maps.shape, teacher(positions, semantics, None).shape)
        assert not torch.allclose(maps.colour[0], maps.colour[1])
    blind = Teacher(replace(TINY, sees_view=False))
    assert torch.equal(blind(positions, semantics, views).colour, blind(positions, semantics, None).colour)


def test_semantics_are_shared_by_the_poses_of_a_batch():
    for semantics_mode in ("sum", "concatenate"):
        torch.manual_seed(0)
        teacher = Teacher(replace(TINY, semantics=semantics_mode))
        positions, semantics, _ = inputs(2)
        once = teacher(positions, semantics[:1]).shape
        torch.testing.assert_close(once, teacher(positions, semantics[:1].expand(2, -1, -1, -1, -1)).shape)


def test_fields_of_the_residuals_partition_the_channels():
    packed = torch.randn(2, 5, 10)
    r = Residuals(packed, torch.randn(2, 5, 3), 0.05)
    joined = torch.cat([r.position / 0.05, r.opacity_logit[..., None], r.log_scales, r.quats], dim=-1)
    torch.testing.assert_close(joined, packed)


def test_sampled_residuals_are_those_of_the_maps():
    torch.manual_seed(0)
    maps = Teacher(TINY)(*inputs(1, 2))
    points = torch.rand(50, 3) - 0.5
    sampler = MapSampler(MapFrame((0.0, 0.0, 0.0)), 32, points, torch.rand(50) < 0.5)
    sampled = maps.sampled(sampler)
    assert sampled.position.shape == (1, 50, 3) and sampled.colour.shape == (2, 50, 3)
    torch.testing.assert_close(sampled.position, sampler(maps.position))
    torch.testing.assert_close(sampled.quats, sampler(maps.quats))


def test_local_offsets_are_rotated_into_the_frames():
    rotations = torch.linalg.qr(torch.randn(6, 3, 3, dtype=torch.float64))[0]
    offsets = torch.randn(2, 6, 3, dtype=torch.float64)
    local = local_offsets(offsets, rotations)
    for i in range(6):
        torch.testing.assert_close(local[1, i], rotations[i].T @ offsets[1, i])
    torch.testing.assert_close(torch.einsum("nij,bnj->bni", rotations, local), offsets)


@pytest.mark.parametrize(
    ("changes", "subject"),
    [
        ({"networks": "two"}, "networks"),
        ({"semantics": "product"}, "semantics"),
        ({"in_size": 20}, "in_size"),
        ({"position_scale": 0.0}, "position_scale"),
        ({"position_scale": float("nan")}, "position_scale"),
        ({"position_size": 64}, "position_size"),
        ({"position_size": -16}, "position_size"),
        ({"position_size": 12}, "size"),
        ({"position_size": 8}, "size"),
    ],
)
def test_refused_configurations(changes, subject):
    with pytest.raises(InputError, match=subject):
        replace(TINY, **changes)


def test_refused_maps():
    teacher = Teacher(TINY)
    positions, semantics, views = inputs(2, 2)
    with pytest.raises(InputError, match="position maps"):
        teacher(positions[:, :, :8], semantics)
    with pytest.raises(InputError, match="semantic maps"):
        teacher(positions, semantics[..., :2])
    with pytest.raises(InputError, match="view maps"):
        teacher(positions, semantics, views[:1])
    with pytest.raises(InputError, match="preset"):
        network_preset("huge")
    assert set(NETWORK_PRESETS) == {"paper", "gpu", "paper-small", "cpu", "demo"}
