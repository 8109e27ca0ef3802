"""Sides of points by depth: those of a convex body's normals, folds with the surface in front of them."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from avatar.models.teacher_avatar import FrontBackAssignment, assign_front_back, map_frame
from avatar.rendering.mesh_maps import MapFrame, vertex_normals
from avatar.rig.rig import Rig
from tests.dolls.dancing import template

SIZE = 256
RADIUS = 0.6
PIXEL = 2.0 / SIZE


def mesh(vertices, faces) -> SimpleNamespace:
    """What is asked of a rig: its surface in the T-pose."""
    return SimpleNamespace(
        vertices=torch.tensor(np.asarray(vertices), dtype=torch.float32), faces=torch.tensor(np.asarray(faces))
    )


def ball(center=(0.0, 0.0, 0.0)) -> SimpleNamespace:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return mesh(sphere.vertices + np.array(center), sphere.faces)


def sides(body: SimpleNamespace | Rig, points: torch.Tensor, normals: torch.Tensor) -> FrontBackAssignment:
    return assign_front_back(body, MapFrame.of(body.vertices.numpy()), SIZE, points, normals)


def own_sides(body: SimpleNamespace | Rig) -> tuple[FrontBackAssignment, torch.Tensor]:
    """Of the body's own vertices, and their normals."""
    normals = vertex_normals(body.vertices, body.faces)
    return sides(body, body.vertices, normals), normals


PROFILE = [(-0.3, 0.24), (0.1, 0.24), (0.1, 0.21), (-0.1, 0.21), (-0.1, 0.18), (0.3, 0.18)]
"""x and z, metres, of a front that folds: its second layer, at 0.21, faces backwards."""
BACK = -0.2


def folded() -> SimpleNamespace:
    """A folded front and a flat back, 60 cm tall."""
    vertices, faces = [], []
    for strip in (PROFILE, [(0.3, BACK), (-0.3, BACK)]):
        for (x0, z0), (x1, z1) in pairwise(strip):
            first = len(vertices)
            vertices += [(x0, -0.3, z0), (x1, -0.3, z1), (x1, 0.3, z1), (x0, 0.3, z0)]
            faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return mesh(vertices, faces)


def on_layer(z: float, count: int = 50) -> torch.Tensor:
    """Points where the fold has all of its layers."""
    random = torch.Generator().manual_seed(0)
    x, y = 0.08 * (2 * torch.rand(2, count, generator=random) - 1)
    return torch.stack([x, 2 * y, torch.full_like(x, z)], dim=1)


@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (0.3, -1.0, 4.0)])
def test_a_convex_bodys_sides_are_those_that_its_normals_face(center):
    found, normals = own_sides(ball(center))
    facing = normals[:, 2].abs() > 0.05
    assert facing.float().mean() > 0.9
    assert torch.equal(found.front[facing], (normals[:, 2] > 0)[facing])
    # By their depth: up to the silhouette nothing else is asked where the maps show them.
    assert torch.equal(sides(ball(center), ball(center).vertices, -normals).front[facing], found.front[facing])


def test_heights_are_not_blended_with_the_background():
    # Far from z = 0, so that a share of it would show.
    found, normals = own_sides(ball((0.0, 0.0, 4.0)))
    steep = normals[:, 2].abs() < 0.3
    # The surface rises by more than 3 pixels within one at the most; a tenth of the background were 40 cm.
    assert found.behind[~steep].abs().max() < PIXEL
    assert steep.any() and found.behind[steep].abs().max() < 0.1


def test_a_fold_of_the_front_is_looked_up_on_the_front():
    body = folded()
    corners = body.vertices[body.faces]
    backwards = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] < 0
    height = corners[:, :, 2].mean(1)
    assert bool(backwards[(height - 0.21).abs() < 1e-6].all())  # the fold's far side, as its faces lie
    for z, facing in ((0.24, 1.0), (0.21, -1.0), (0.18, 1.0)):
        found = sides(body, on_layer(z), torch.tensor([0.0, 0.0, facing]).expand(50, 3))
        assert bool(found.front.all())
        torch.testing.assert_close(found.behind, torch.full((50,), 0.24 - z), rtol=0, atol=1e-5)
    found = sides(body, on_layer(BACK), torch.tensor([0.0, 0.0, 1.0]).expand(50, 3))
    assert not found.front.any() and found.behind.abs().max() < 1e-5


@pytest.mark.parametrize("facing", [-1.0, 1.0])
def test_the_direction_of_a_point_that_is_shown_does_not_matter(facing):
    inside = on_layer(0.1)
    found = sides(folded(), inside, torch.tensor([0.0, 0.0, facing]).expand(50, 3))
    # 14 cm below the front, 30 cm above the back.
    assert bool(found.front.all())
    torch.testing.assert_close(found.behind, torch.full((50,), 0.14), rtol=0, atol=1e-5)


def test_an_inner_points_depth_is_that_below_the_nearer_surface():
    random = torch.Generator().manual_seed(1)
    points = 0.35 * (2 * torch.rand(300, 3, generator=random) - 1)
    found = sides(ball(), points, torch.zeros(300, 3))
    surface = (RADIUS**2 - points[:, :2].square().sum(1)).sqrt()
    apart = points[:, 2].abs() > 1e-3
    assert torch.equal(found.front[apart], points[apart, 2] > 0)
    torch.testing.assert_close(found.behind, surface - points[:, 2].abs(), rtol=0, atol=2e-3)


def test_a_point_above_the_surface_is_less_than_nothing_behind_it():
    found = sides(ball(), torch.tensor([[0.0, 0.0, 0.65], [0.0, 0.0, -0.62]]), torch.zeros(2, 3))
    assert found.front.tolist() == [True, False]
    torch.testing.assert_close(found.behind, torch.tensor([-0.05, -0.02]), rtol=0, atol=1e-3)


def test_where_the_maps_show_nothing_the_normal_decides():
    points = torch.tensor([[0.55, 0.55, 0.4], [0.55, 0.55, -0.4], [-0.9, 0.0, 0.0], [-0.9, 0.0, 0.0]])
    normals = torch.tensor([[0.0, 0.0, -1.0], [0.8, 0.0, 0.6], [1.0, 0.0, 0.0], [0.6, 0.0, -0.8]])
    found = sides(ball(), points, normals)
    assert found.front.tolist() == [False, True, True, False]
    assert found.behind.abs().max() == 0


def test_a_body_turned_round_has_its_sides_changed_over():
    rig = Rig(template())
    normals = vertex_normals(rig.vertices, rig.faces)
    turn = torch.tensor([-1.0, 1.0, -1.0])
    turned = mesh(rig.vertices * turn, rig.faces)
    frame = map_frame(rig)
    there = MapFrame((-frame.center[0], frame.center[1], -frame.center[2]), frame.half_extent)
    one = assign_front_back(rig, frame, SIZE, rig.vertices, normals)
    two = assign_front_back(turned, there, SIZE, turned.vertices, normals * turn)
    apart = rig.vertices[:, 2].abs() > 0.02  # the doll is alike in front and behind: elsewhere both are as near
    assert torch.equal(one.front[apart], ~two.front[apart])
    torch.testing.assert_close(one.behind[apart], two.behind[apart], rtol=0, atol=1e-4)


def test_skin_under_a_dress_is_behind_it_by_the_gap():
    it = template()
    rig = Rig(it)
    found, _ = own_sides(rig)
    x, y, z = (torch.tensor(it.vertices, dtype=torch.float32) - torch.tensor([0.0, 0.3, 0.0])).unbind(-1)
    within = 1.0 - (x / 0.25).square() - (y / 0.31).square()
    torso = torch.zeros(len(it.vertices), dtype=torch.bool)
    torso[: len(it.vertices) // 3] = True
    under = torso & (within > 0.4) & (z.abs() > 0.02)
    gap = 0.19 * within.clamp(min=0.0).sqrt() - z.abs()
    assert under.sum() > 20 and gap[under].min() > 0.01
    torch.testing.assert_close(found.behind[under], gap[under], rtol=0, atol=8e-3)  # the dress has 320 flat faces
