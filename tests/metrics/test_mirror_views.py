"""A mirrored scan is told by its colours in photographs."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core import Camera, TriangleMesh
from smplxpp.metrics import mirrored_by_views
from smplxpp.raster import rasterize_mesh

X = np.array([1.0, 0.0, 0.0])


def figure_colors(points: np.ndarray, *, lopsided: bool) -> np.ndarray:
    """Stripes; `lopsided`: with a badge on the left of the chest and one sleeve of another colour."""
    x, y, z = points.T
    colors = np.stack([0.5 + 0.3 * np.sin(30 * y), 0.5 + 0.3 * np.sin(12 * np.abs(x)), np.full(len(x), 0.4)], axis=1)
    if lopsided:
        colors[(x > 0.1) & (x < 0.3) & (y > 0.1) & (z > 0)] = [0.9, 0.9, 0.1]
        colors[x < -0.35] = [0.1, 0.2, 0.6]
    return colors


@pytest.fixture
def toy(sphere) -> TriangleMesh:
    """A shape that is its own mirror image: nothing but colours can tell."""
    ball = sphere(0.5)
    return ball.with_vertices(ball.vertices * [1.0, 1.6, 0.6])


def photographs(mesh: TriangleMesh, colors: np.ndarray, *, noise: float = 0.01) -> list[tuple[Camera, np.ndarray]]:
    """What two cameras, of other exposures, see of a mesh before a bright wall."""
    rng, views = np.random.default_rng(0), []
    for eye, gain in (([0.8, 0.3, 2.6], 0.7), ([-1.2, 0.0, -2.4], 1.0)):
        camera = Camera.look_at(eye=np.array(eye), target=np.zeros(3), fov_y_deg=45, width=120, height=160)
        seen = rasterize_mesh(mesh, camera).interpolate(mesh.faces, gain * colors + 0.05, background=0.9)
        views.append((camera, np.clip(seen + noise * rng.normal(size=seen.shape), 0.0, 1.0)))
    return views


def mirrored(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices * [-1, 1, 1], np.ascontiguousarray(mesh.faces[:, ::-1]))


def share(scan: TriangleMesh, colors: np.ndarray, views: list, body: TriangleMesh) -> float | None:
    return mirrored_by_views(scan, colors, views, body=body, center=np.zeros(3), across=2.0 * X)


@pytest.mark.long
def test_a_scan_and_its_mirror_image_are_told_apart(toy):
    colors = figure_colors(toy.vertices, lopsided=True)
    views = photographs(toy, colors)
    assert share(toy, colors, views, toy) < 0.1
    assert share(mirrored(toy), colors, views, toy) > 0.9


@pytest.mark.long
def test_a_scan_and_a_body_that_are_a_little_off_are_told_as_well(toy):
    colors = figure_colors(toy.vertices, lopsided=True)
    views = photographs(toy, colors)
    moved = toy.with_vertices(toy.vertices + [0.012, -0.01, 0.01])
    body = toy.with_vertices(toy.vertices - [0.008, 0.0, 0.01])
    assert share(moved, colors, views, body) < 0.2
    assert share(mirrored(moved), colors, views, body) > 0.8


@pytest.mark.long
def test_symmetric_colours_tell_nothing(toy):
    colors = figure_colors(toy.vertices, lopsided=False)
    views = photographs(toy, colors)
    noisy = np.clip(colors + 0.05 * np.random.default_rng(1).normal(size=colors.shape), 0.0, 1.0)
    for scan in (toy, mirrored(toy), toy.with_vertices(toy.vertices + [0.01, 0.01, 0.0])):
        assert 0.35 < share(scan, noisy, views, toy) < 0.6


@pytest.mark.long
def test_one_colour_and_photographs_of_something_else_tell_nothing(toy):
    colors = figure_colors(toy.vertices, lopsided=True)
    views = photographs(toy, colors)
    assert share(toy, np.full_like(colors, 0.5), views, toy) is None
    noise = [(camera, np.random.default_rng(2).random(seen.shape)) for camera, seen in views]
    assert share(toy, colors, noise, toy) is None


@pytest.mark.long
def test_no_view_or_none_that_shows_the_scan_tells_nothing(toy):
    colors = figure_colors(toy.vertices, lopsided=True)
    away = toy.with_vertices(toy.vertices + [50.0, 0.0, 0.0])
    assert share(toy, colors, [], toy) is None
    assert share(away, colors, photographs(toy, colors), away) is None
