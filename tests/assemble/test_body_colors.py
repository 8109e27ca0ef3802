from __future__ import annotations

import numpy as np
import pytest
import trimesh

from smplxpp.assemble import body_colors_from_scan
from smplxpp.core import InputError, TriangleMesh


@pytest.fixture(scope="module")
def ball() -> TriangleMesh:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return TriangleMesh(sphere.vertices, sphere.faces)


def test_bare_skin_takes_the_colour_beside_it_and_covered_skin_the_median(ball):
    scan = ball.with_vertices(ball.vertices * 1.01)
    colors = np.full((scan.vertex_count, 3), (200, 150, 120), np.uint8)
    colors[scan.vertices[:, 0] > 0.3] = (90, 60, 50)
    skin = (scan.triangles[:, :, 1] > 0).all(axis=1)
    got, index = body_colors_from_scan(ball, scan, colors, skin)
    above, below = ball.vertices[:, 1] > 0.05, ball.vertices[:, 1] < -0.05
    np.testing.assert_array_equal(got[above], colors[above])
    np.testing.assert_array_equal(index[above], np.flatnonzero(above))
    assert (index[below] == -1).all()
    assert (got[below] == (200, 150, 120)).all()


def test_far_or_turned_surfaces_give_no_colour(ball):
    skin = np.ones(ball.face_count, bool)
    colors = np.zeros((ball.vertex_count, 3), np.uint8)
    far = ball.with_vertices(ball.vertices * 1.2)
    inside_out = TriangleMesh(ball.vertices * 1.01, ball.faces[:, ::-1])
    for scan in (far, inside_out):
        assert (body_colors_from_scan(ball, scan, colors, skin)[1] == -1).all()


def test_a_scan_without_skin_leaves_the_body_grey(ball):
    colors, index = body_colors_from_scan(
        ball, ball, np.zeros((ball.vertex_count, 3), np.uint8), np.zeros(ball.face_count, bool)
    )
    assert (colors == 180).all()
    assert (index == -1).all()


def test_arrays_of_another_mesh_are_refused(ball):
    with pytest.raises(InputError, match="skin faces"):
        body_colors_from_scan(ball, ball, np.zeros((3, 3)), np.zeros(ball.face_count, bool))
