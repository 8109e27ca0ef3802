from dataclasses import replace

import numpy as np
import pytest

from smplxpp.reconstruct.colors import blend_colors
from smplxpp.reconstruct.hull import zero_surface
from smplxpp.reconstruct.photographs import Pyramids, sight
from tests.reconstruct.scene import BOX, inside_ball, photograph, ring, texture


@pytest.fixture(scope="module")
def ball():
    return zero_surface(inside_ball, BOX, cell=0.025)


@pytest.fixture(scope="module")
def views(ball):
    return [photograph(ball, camera, str(k)) for k, camera in enumerate(ring())]


def colors_of(ball, views):
    pyramids = Pyramids.of(views)
    seen = sight(ball, ball.vertex_normals, pyramids.cameras)
    return blend_colors(ball, seen, pyramids), seen


def test_the_colours_are_those_of_the_surface(ball, views):
    (colors, gains), seen = colors_of(ball, views)
    true = 255 * texture(ball.vertices)
    squarely = (seen.cosine > 0.5).sum(axis=1) >= 2
    assert np.abs(colors[squarely] - true[squarely]).mean() < 8
    assert gains == pytest.approx(1.0, abs=0.03)


def test_a_dim_camera_is_made_as_bright_as_the_others(ball, views):
    dim = list(views)
    dim[0] = replace(dim[0], color=(0.7 * dim[0].color).astype(np.uint8))
    (colors, gains), _ = colors_of(ball, dim)
    (good, _), _ = colors_of(ball, views)
    assert gains[0] / np.median(gains, axis=0) == pytest.approx(1 / 0.7, rel=0.1)
    assert np.abs(colors.astype(float) - good).mean() < 8


def test_a_view_that_shows_something_else_counts_little(ball, views):
    wrong = list(views)
    wrong[2] = replace(wrong[2], color=np.full_like(wrong[2].color, 255))
    (colors, _), seen = colors_of(ball, wrong)
    (good, _), _ = colors_of(ball, views)
    many = (seen.cosine > 0.4).sum(axis=1) >= 4
    assert np.abs(colors[many].astype(float) - good[many]).mean() < 12


def test_what_nobody_sees_takes_its_neighbours_colours(ball, views):
    above = [view for view in views if view.camera.position[1] > 0]
    plain = [replace(view, color=np.full_like(view.color, (200, 100, 50))) for view in above]
    (colors, _), seen = colors_of(ball, plain)
    assert ((seen.cosine > 0.3).sum(axis=1) == 0).any()
    assert np.abs(colors.astype(int) - (200, 100, 50)).max() <= 2
