from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.reconstruct import NeuralSurface, SurfaceConfig, fit_surface
from avatar.reconstruct.fit_surface import hull_grid, opacities, rays_of, weights_of
from avatar.reconstruct.neural_surface import HashGrid
from smplxpp.core import InputError, TriangleMesh
from smplxpp.reconstruct.hull import solid_status, zero_surface
from tests.reconstruct.scene import BOX, RADIUS, inside_ball, photograph, ring

TINY = SurfaceConfig(
    **{"iterations": 60, "rays": 96, "samples": 12, "behind": 0.15, "rate": 1e-2, "mask": 1.0},
    **{"levels": 2, "finest": 16, "log2_entries": 12, "hull_cell": 0.06, "cell": 0.04},
)


@pytest.fixture(scope="module")
def ball():
    return zero_surface(inside_ball, BOX, cell=0.04)


def large(ball):
    """A hull 10 % too large."""
    return TriangleMesh(1.1 * ball.vertices, ball.faces)


def test_a_grid_interpolates_between_its_corners():
    grid = HashGrid(levels=1, coarsest=4, finest=4, log2_entries=10, features=1)
    with torch.no_grad():
        index = torch.arange(125.0)
        x = (index // 25) / 4
        grid.tables[0][:, 0] = 3 * x - 1
    points = torch.rand(50, 3)
    assert grid(points)[:, 0].tolist() == pytest.approx((3 * points[:, 0] - 1).tolist(), abs=1e-5)


def test_hashed_levels_are_continuous_across_cells_and_stay_in_their_tables():
    grid = HashGrid(levels=3, coarsest=8, finest=128, log2_entries=8)
    with torch.no_grad():
        for table in grid.tables:
            table.uniform_(-1, 1)
    side = torch.tensor([[0.5 - 1e-6, 0.3, 0.7], [0.5 + 1e-6, 0.3, 0.7]])
    found = grid(side)
    assert found.shape == (2, grid.width)
    assert found[0].tolist() == pytest.approx(found[1].tolist(), abs=1e-3)
    assert torch.isfinite(grid(torch.rand(500, 3) * 3 - 1)).all()


def test_a_grid_without_sense_is_refused():
    with pytest.raises(InputError, match="hash grid"):
        HashGrid(levels=0)
    with pytest.raises(InputError, match="surface config"):
        SurfaceConfig(iterations=0)


@pytest.mark.long
def test_the_untrained_surface_is_the_hull(ball):
    grid = hull_grid(ball, BOX, 0.03)
    low, high = (torch.from_numpy(side.astype(np.float32)) for side in (BOX.low, BOX.high))
    model = NeuralSurface(grid, low, high, HashGrid(levels=2, finest=32, log2_entries=10))
    points = torch.rand(200, 3) - 0.5
    with torch.no_grad():
        found = model.distance(points)
        gradient = model.gradient(points[points.norm(dim=1) > 0.3], step=0.02)
    assert found.tolist() == pytest.approx((points.norm(dim=1) - RADIUS).tolist(), abs=0.02)
    assert gradient.norm(dim=1).mean().item() == pytest.approx(1.0, abs=0.03)


def test_a_wall_weighs_where_it_stands_and_all_in_all_one():
    depth = torch.linspace(0, 1, 101)[None]
    weights = weights_of(opacities(0.4 - depth, torch.tensor(200.0)))
    assert weights.sum().item() == pytest.approx(1.0, abs=1e-3)
    middle = 0.5 * (depth[:, 1:] + depth[:, :-1])
    assert (weights * middle).sum().item() == pytest.approx(0.4, abs=0.01)
    assert weights_of(opacities(1.0 + depth, torch.tensor(200.0))).sum().item() < 1e-6


def test_rays_go_through_their_pixels_and_know_where_the_hull_begins(ball):
    view = photograph(ball, ring(6, size=40)[0], "one")
    rays = rays_of([view], ball, "cpu")
    points = (rays.origin + rays.enter[:, None] * rays.direction).numpy().astype(np.float64)
    assert np.linalg.norm(points, axis=1) == pytest.approx(RADIUS, abs=0.01)
    places = view.camera.screen_from_world(points)[:, :2]
    assert places - np.floor(places) == pytest.approx(0.5, abs=1e-3)
    with pytest.raises(InputError, match="show the hull"):
        rays_of([view], TriangleMesh(ball.vertices + 100.0, ball.faces), "cpu")


@pytest.mark.long
def test_a_sphere_is_found_under_a_hull_that_is_too_large(ball):
    views = [photograph(ball, camera, str(k), plain=True) for k, camera in enumerate(ring(6, size=40))]
    found = fit_surface(views, large(ball), TINY, device="cpu")
    before = np.abs(np.linalg.norm(1.1 * ball.vertices, axis=1) - RADIUS).mean()
    after = np.abs(np.linalg.norm(found.mesh.vertices, axis=1) - RADIUS).mean()
    assert found.losses[-10:].mean() < 0.3 * found.losses[:10].mean()
    assert after < 0.3 * before
    assert solid_status(found.mesh)[0] == "NoError"
    again = fit_surface(views, large(ball), replace(TINY, iterations=3), device="cpu")
    assert (again.losses[:1] == found.losses[:1]).all()
