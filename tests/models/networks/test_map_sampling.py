"""Lookup of Gaussians in front and back maps: against torch's own sampling, analytic maps and the mesh rasteriser."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import trimesh

from avatar.models.networks.sparse_lookups import MapSampler
from avatar.rendering.mesh_maps import MapFrame
from smplxpp.core import InputError, TriangleMesh
from smplxpp.raster import rasterize_mesh

FRAME = MapFrame((0.1, -0.2, 0.3), half_extent=0.8)


def random_gaussians(count: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.tensor(FRAME.center) + 0.79 * (2 * torch.rand(count, 3, generator=generator) - 1)
    return points, torch.randn(count, 3, generator=generator)


def linear_maps(size: int, value) -> torch.Tensor:
    """(1, 2, size, size, C) maps whose pixels hold value(x, y, side) at their centres."""
    step = 2 * FRAME.half_extent / size
    x = FRAME.center[0] - FRAME.half_extent + step * (torch.arange(size) + 0.5)
    y = FRAME.center[1] + FRAME.half_extent - step * (torch.arange(size) + 0.5)
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([torch.stack(value(x, y, side), dim=-1) for side in (0, 1)])[None]


def test_linear_maps_are_reproduced_on_the_side_that_is_faced():
    points, normals = random_gaussians()
    inner = (points[:, :2] - torch.tensor(FRAME.center[:2])).abs().amax(1) < 0.7
    points, normals = points[inner], normals[inner]
    maps = linear_maps(32, lambda x, y, side: (2 * x - 3 * y, y, torch.full_like(x, side)))
    values = MapSampler(FRAME, 32, points, normals[:, 2] >= 0)(maps)[0]
    expected = torch.stack([2 * points[:, 0] - 3 * points[:, 1], points[:, 1], (normals[:, 2] < 0).float()], dim=1)
    torch.testing.assert_close(values, expected, atol=1e-5, rtol=1e-5)


def test_equals_grid_sample_with_its_gradient():
    points, normals = random_gaussians()
    maps = torch.randn(2, 2, 16, 16, 5, dtype=torch.float64, requires_grad=True)
    sampler = MapSampler(FRAME, 16, points.double(), normals[:, 2] >= 0)
    values = sampler(maps)
    grid = (FRAME.pixels_from_canonical(points.double(), 16) / 8 - 1)[None, None].expand(2, -1, -1, -1)
    sides = [
        F.grid_sample(maps[:, s].permute(0, 3, 1, 2), grid, padding_mode="border", align_corners=False)[:, :, 0]
        for s in (0, 1)
    ]
    expected = torch.where(normals[:, 2] >= 0, *sides).transpose(1, 2)
    torch.testing.assert_close(values, expected)
    weights = torch.randn_like(values)
    (mine,) = torch.autograd.grad((values * weights).sum(), maps)
    (theirs,) = torch.autograd.grad((expected * weights).sum(), maps)
    torch.testing.assert_close(mine, theirs)


def test_turning_a_normal_round_changes_the_side():
    points, normals = random_gaussians()
    maps = torch.randn(1, 2, 16, 16, 3)
    turned = MapSampler(FRAME, 16, points, (-normals)[:, 2] >= 0)(maps)
    torch.testing.assert_close(turned, MapSampler(FRAME, 16, points, normals[:, 2] >= 0)(maps.flip(1)))


def test_agrees_with_the_rasterised_maps():
    # A sphere coloured by its own coordinates: what is looked up where a point lies must be that point.
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.6)
    mesh = TriangleMesh(np.asarray(sphere.vertices) + FRAME.center, np.asarray(sphere.faces))
    size = 128
    maps = [
        rasterize_mesh(mesh, camera).interpolate(mesh.faces, mesh.vertices, background=0.0)
        for camera in FRAME.cameras(size)
    ]
    maps = torch.tensor(np.stack(maps))[None]
    facing = np.abs(sphere.vertex_normals[:, 2]) > 0.5
    points = torch.tensor(mesh.vertices[facing])
    normals = torch.tensor(np.array(sphere.vertex_normals[facing]))
    found = MapSampler(FRAME, size, points, normals[:, 2] >= 0)(maps)[0]
    assert (found - points).abs().max() < 0.003  # a quarter of a pixel


def test_frame_is_about_the_box():
    vertices = np.array([[-1.0, 0.0, 2.0], [0.5, 1.6, 2.2], [0.0, 0.1, 2.1]])
    assert MapFrame.of(vertices).center == pytest.approx((-0.25, 0.8, 2.1))


@pytest.mark.parametrize("bad", [float("nan"), 5.0])
def test_points_outside_are_refused(bad):
    points, normals = random_gaussians(4)
    points[2, 1] = bad
    with pytest.raises(InputError, match=r"within 0\.8 m"):
        MapSampler(FRAME, 16, points, normals[:, 2] >= 0)


def test_wrong_shapes_are_refused():
    points, normals = random_gaussians(4)
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        MapSampler(FRAME, 16, points, normals[:2][:, 2] >= 0)
    with pytest.raises(InputError, match="16, 16"):
        MapSampler(FRAME, 16, points, normals[:, 2] >= 0)(torch.zeros(1, 2, 8, 8, 3))
