"""The student's field against the paper's equation written out, its start at zero, and its frame codes."""

from __future__ import annotations

import math

import pytest
import torch

from avatar.models.networks.control_points import choose_control_points
from avatar.models.networks.deformation_field import (
    DeformationField,
    FieldConfig,
    FrameCodes,
    positional_encoding,
    show_null_code,
)
from smplxpp.core.errors import InputError

CONFIG = FieldConfig(width=16, hidden_layers=2)


def random_field(config: FieldConfig = CONFIG, vertices: int = 30, **options) -> DeformationField:
    torch.manual_seed(0)
    points = torch.rand(vertices, 3) - 0.5
    field = DeformationField(config, points, torch.arange(vertices) % 3 == 0, **options)
    with torch.no_grad():
        for network in (field.body, field.cloth):
            torch.nn.init.normal_(network.last.weight)
            torch.nn.init.normal_(network.last.bias)
    return field


def drive(batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return torch.randn(batch, 63, generator=generator), torch.randn(batch, 32, generator=generator)


def test_parameters_of_each_network_are_about_25_thousand():
    field = DeformationField(FieldConfig(), torch.rand(5, 3), torch.ones(5, dtype=torch.bool))
    counts = [sum(p.numel() for p in network.parameters()) for network in (field.body, field.cloth)]
    # (39 + 63 + 32) 64 + 64, four times 64 64 + 64, 64 3 + 3
    assert counts == [25475, 25475]


def test_starts_at_zero_with_a_gradient():
    field = DeformationField(CONFIG, torch.rand(9, 3), torch.ones(9, dtype=torch.bool))
    displacements = field(*drive())
    assert displacements.shape == (2, 9, 3) and displacements.abs().max() == 0
    (displacements - 1).square().sum().backward()
    assert field.body.last.weight.grad.abs().sum() > 0 and field.cloth.last.weight.grad.abs().sum() > 0


@pytest.mark.parametrize("seed", range(5))
def test_points_and_frames_are_told_apart_from_the_start(seed):
    """Else the last layer has nothing but a constant to learn with, and all dies that is pushed below zero."""
    torch.manual_seed(seed)
    network = DeformationField(FieldConfig(), torch.rand(200, 3) - 0.5, torch.ones(200, dtype=torch.bool)).body
    said = []
    network.last.register_forward_pre_hook(lambda module, given: said.append(given[0]))
    points, (pose, code) = torch.rand(200, 3) - 0.5, drive(8)
    network(positional_encoding(points, 6), torch.cat([0.3 * pose, 0.1 * code], dim=1)[:, None], None)
    (last,) = said
    assert last.flatten(0, 1).std(dim=0).mean() > 0.3 * last.mean() > 0.0
    assert last.mean(dim=1).std(dim=0).mean() > 0.02 * last.mean()


def test_equation_written_out():
    field = random_field()
    pose, code = drive(1)
    torch.manual_seed(0)
    points = torch.rand(30, 3) - 0.5
    displacements = field(pose, code)[0]
    for i in (0, 1, 3):
        g = torch.cat([positional_encoding(points[i], 6), pose[0], code[0]])
        total = torch.zeros(3)
        for network, share in ((field.cloth, float(i % 3 == 0)), (field.body, 1.0)):
            first = torch.cat([network.of_point.weight, network.of_frame.weight], dim=1)
            x = torch.relu(first @ g + network.of_frame.bias)
            for layer in network.hidden:
                x = torch.relu(layer(x))
            total = total + share * network.last(x)
        torch.testing.assert_close(displacements[i], total, rtol=1e-4, atol=1e-5)


def test_gradients_reach_every_parameter_the_pose_and_the_code():
    field = random_field()
    pose, code = (value.requires_grad_() for value in drive())
    field(pose, code).square().sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in field.parameters())
    assert pose.grad.abs().sum() > 0 and code.grad.abs().sum() > 0


def test_cloth_network_moves_cloth_alone():
    field = random_field()
    pose, code = drive()
    before = field(pose, code)
    with torch.no_grad():
        field.cloth.last.bias += 1.0
    moved = (field(pose, code) - before).abs().amax((0, 2)) > 0
    assert torch.equal(moved, torch.arange(30) % 3 == 0)


def test_positional_encoding():
    encoded = positional_encoding(torch.tensor([0.25, -0.5, 1.0]), 2)
    expected = [0.25, -0.5, 1.0]
    for function in (math.sin, math.cos):
        expected += [function(band * math.pi * x) for band in (1, 2) for x in (0.25, -0.5, 1.0)]
    torch.testing.assert_close(encoded, torch.tensor(expected), atol=1e-6, rtol=1e-5)
    assert FieldConfig().encoding_size == positional_encoding(torch.zeros(3), 6).numel() == 39


def test_every_vertex_a_control_point_is_the_plain_field():
    torch.manual_seed(0)
    points = torch.rand(30, 3) - 0.5
    control = choose_control_points(points.numpy(), torch.arange(30).numpy() % 3 == 0, count=30)
    plain, controlled = random_field(), random_field(control=control)
    controlled.load_state_dict(plain.state_dict())
    torch.testing.assert_close(controlled(*drive()), plain(*drive()), rtol=1e-4, atol=1e-5)


def test_control_points_keep_what_the_networks_say_there():
    points = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    control = choose_control_points(points.numpy(), torch.arange(30).numpy() % 3 == 0, count=12)
    field = random_field(control=control)
    own, everywhere = field.at_points(*drive()), field(*drive())
    assert own.shape == (2, 12, 3) and torch.equal(field.points, torch.as_tensor(control.vertices))
    torch.testing.assert_close(everywhere[:, field.points], own, rtol=1e-4, atol=1e-5)
    # Between them a vertex lies between its neighbours.
    assert bool((everywhere.amax(1) <= own.amax(1) + 1e-5).all() and (everywhere.amin(1) >= own.amin(1) - 1e-5).all())


LOCAL = FieldConfig(width=16, hidden_layers=2, local_pose=1)


def some_joints(vertices: int = 30) -> torch.Tensor:
    return torch.rand(vertices, 21, generator=torch.Generator().manual_seed(5)).gt(0.5)[torch.arange(vertices) // 4]


def test_a_vertex_does_not_notice_joints_that_it_does_not_see():
    seen = some_joints()
    field = random_field(LOCAL, seen=seen)
    pose, code = drive(1)
    before = field(pose, code)[0]
    for joint in (0, 7, 20):
        turned = pose.clone()
        turned[0, 3 * joint : 3 * joint + 3] += 1.0
        moved = (field(turned, code)[0] - before).abs().amax(1) > 1e-6
        assert torch.equal(moved, seen[:, joint])


def test_seeing_all_joints_is_the_plain_field():
    plain, local = random_field(), random_field(LOCAL, seen=torch.ones(30, 21, dtype=torch.bool))
    assert plain.state_dict().keys() == local.state_dict().keys()
    torch.testing.assert_close(local(*drive()), plain(*drive()), rtol=1e-5, atol=1e-6)


def test_control_points_see_what_their_vertices_see():
    torch.manual_seed(0)
    points = torch.rand(30, 3) - 0.5
    control = choose_control_points(points.numpy(), torch.arange(30).numpy() % 3 == 0, count=12)
    whole = random_field(LOCAL, seen=some_joints())
    controlled = random_field(LOCAL, seen=some_joints(), control=control)
    at_points = controlled.at_points(*drive())
    torch.testing.assert_close(at_points, whole(*drive())[:, controlled.points], rtol=1e-4, atol=1e-5)


def test_without_control_points_the_points_are_all_vertices():
    field = random_field()
    assert torch.equal(field.points, torch.arange(30))
    assert torch.equal(field.at_points(*drive()), field(*drive()))


@pytest.mark.parametrize("controlled", [False, True])
def test_what_is_still_does_not_move_and_the_rest_moves_as_without(controlled):
    torch.manual_seed(0)
    points, group = torch.rand(30, 3) - 0.5, torch.arange(30) % 3
    still = group == 1  # clothes are the group 0
    control = choose_control_points(points.numpy(), group.numpy(), count=12) if controlled else None
    plain, held = random_field(control=control), random_field(control=control, still=still)
    held.load_state_dict(plain.state_dict())
    a, b = plain(*drive()), held(*drive())
    assert not b[:, still].any() and a[:, still].abs().min() > 0
    torch.testing.assert_close(b[:, ~still], a[:, ~still], rtol=1e-4, atol=1e-5)
    assert not still[held.points].any() and len(held.points) < len(plain.points)
    torch.testing.assert_close(held.at_points(*drive()), b[:, held.points], rtol=1e-4, atol=1e-5)
    b.square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in held.cloth.parameters())


def test_state_does_not_hold_the_template():
    assert all("weight" in name or "bias" in name for name in random_field().state_dict())


def test_codes_by_frame_and_the_null_code():
    codes = FrameCodes((7, 3, 12), 4)
    assert codes((7, 3)).abs().max() == 0
    with torch.no_grad():
        codes.codes.copy_(torch.arange(12.0).view(3, 4) + 1)
    assert torch.equal(codes((None,))[0], codes.codes[0])  # until training shows the null code
    show_null_code(codes)
    rows = codes((12, None, 7))
    assert torch.equal(rows, torch.stack([codes.codes[2], torch.zeros(4), codes.codes[0]]))
    rows.sum().backward()
    assert torch.equal(codes.codes.grad.sum(1), torch.tensor([4.0, 0.0, 4.0]))


def test_refused_input():
    with pytest.raises(InputError, match="cloth mask"):
        DeformationField(CONFIG, torch.rand(5, 3), torch.ones(4, dtype=torch.bool))
    with pytest.raises(InputError, match="pose and code"):
        random_field()(torch.zeros(1, 62), torch.zeros(1, 32))
    with pytest.raises(InputError, match="pose and code"):
        random_field()(torch.zeros(2, 63), torch.zeros(1, 32))
    with pytest.raises(InputError, match="control points"):
        random_field(control=choose_control_points(torch.rand(10, 3).numpy(), torch.zeros(10).numpy(), count=4))
    with pytest.raises(InputError, match="width"):
        FieldConfig(width=0)
    with pytest.raises(InputError, match="each once"):
        FrameCodes((1, 1), 4)
    with pytest.raises(InputError, match="null code"):
        FrameCodes((1, 2), 4)((5,))
    for config, options in ((LOCAL, {}), (CONFIG, {"seen": some_joints(5)}), (LOCAL, {"seen": some_joints(4)})):
        with pytest.raises(InputError, match="joints that the vertices see"):
            DeformationField(config, torch.rand(5, 3), torch.ones(5, dtype=torch.bool), **options)
    with pytest.raises(InputError, match="local_pose"):
        FieldConfig(local_pose=-1)
    for still in (torch.ones(5, dtype=torch.bool), torch.zeros(4, dtype=torch.bool)):
        with pytest.raises(InputError, match="stay still"):
            DeformationField(CONFIG, torch.rand(5, 3), torch.ones(5, dtype=torch.bool), still=still)
