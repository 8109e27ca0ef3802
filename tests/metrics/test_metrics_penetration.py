"""Signed distance and penetration on closed, open, nested and overlapping surfaces, and on the capture's body."""

from __future__ import annotations

import igl
import numpy as np
import pytest

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.metrics import penetration, signed_distance


def test_depth_in_a_sphere_is_exact(sphere):
    ball = sphere(1.0)
    points = np.array([[0.95, 0, 0], [0, 1.02, 0], [0, 0, 0.99], [0, 0, 0.2]])
    signed, _, _ = signed_distance(points, ball)
    np.testing.assert_allclose(signed, [-0.05, 0.02, -0.01, -0.8], atol=1e-3)
    report = penetration(points, ball)
    assert report.count == 3
    np.testing.assert_array_equal(report.penetrating, [True, False, True, True])
    assert report.depth_max_mm == pytest.approx(800, abs=1)
    assert report.depth_mean_mm == pytest.approx(860 / 3, abs=1)
    assert report.fraction == 0.75


def test_clearance_counts_points_that_are_too_near(sphere):
    ball = sphere(1.0)
    shell = sphere(1.004)
    assert penetration(shell, ball).count == 0
    report = penetration(shell, ball, clearance=0.005)
    assert report.count == shell.vertex_count
    assert report.depth_mean_mm == pytest.approx(1.0, abs=0.1)
    assert set(report.as_dict()) == {"count", "fraction", "depth_mean_mm", "depth_max_mm", "clearance_mm"}


def test_vertices_of_the_surface_itself_do_not_penetrate(sphere):
    ball = sphere(1.0, 4)
    report = penetration(ball, ball)
    assert (report.count, report.depth_max_mm, report.depth_mean_mm) == (0, 0.0, 0.0)


def test_overlapping_and_nested_pieces_count_as_their_union(sphere):
    """The closest face of a nested piece points the wrong way for a normal test: eyes inside a head."""
    head, eye = sphere(1.0, 4), sphere(0.2, 3)
    both = concatenate_meshes([head, eye, head.with_vertices(head.vertices + [1.0, 0, 0])])
    points = np.array([[0.3, 0, 0], [0, 0.1, 0], [0.5, 0, 0], [-0.9, 0, 0], [0.5, 0.95, 0]])
    signed, _, _ = signed_distance(points, both)
    np.testing.assert_array_equal(signed < 0, [True, True, True, True, False])


def test_an_open_surface_keeps_its_inside(sphere):
    ball = sphere(1.0, 4)
    open_ball, _ = ball.submesh(ball.triangles.mean(axis=1)[:, 1] < 0.9)
    assert len(open_ball.border_edges)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    points *= (rng.choice([0.9, 1.1], 500) / np.linalg.norm(points, axis=1))[:, None]
    away = points[:, 1] < 0.6
    signed, _, _ = signed_distance(points[away], open_ball)
    np.testing.assert_array_equal(signed < 0, np.linalg.norm(points[away], axis=1) < 1)


def test_bad_input_is_refused(sphere):
    ball = sphere(1.0, 2)
    with pytest.raises(InputError, match="counter-clockwise"):
        penetration(ball, TriangleMesh(ball.vertices, ball.faces[:, ::-1]))
    with pytest.raises(InputError, match="clearance"):
        penetration(ball, ball, clearance=-1.0)
    with pytest.raises(InputError, match="points"):
        penetration(np.zeros((0, 3)), ball)
    with pytest.raises(InputError, match="points"):
        penetration(np.full((2, 3), np.nan), ball)


def test_the_body_of_a_capture_against_the_exact_winding_number(captures):
    geometry = captures / "woman_casual" / "geometry"
    with np.load(geometry / "topology.npz") as topology, np.load(geometry / "frame_000000.npz") as frame:
        count = int(topology["body_vertex_count"])
        inside = (topology["faces"] < count).all(axis=1)
        body = TriangleMesh(frame["verts"][:count], topology["faces"][inside])
    rng = np.random.default_rng(0)
    pick = rng.choice(body.vertex_count, 1500, replace=False)
    points = body.vertices[pick] + body.vertex_normals[pick] * rng.choice([-5e-3, -2e-4, 2e-4, 5e-3], 1500)[:, None]
    signed, _, _ = signed_distance(points, body)
    exact = igl.winding_number(body.vertices, body.faces, points) > 0.5
    unclear = np.abs(signed) < 1e-5
    np.testing.assert_array_equal((signed < 0)[~unclear], exact[~unclear])
