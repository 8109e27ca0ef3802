"""Mesh quality of shapes with known defects; self-intersections against libigl's test of every pair."""

from __future__ import annotations

import igl
import numpy as np
import pytest

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.metrics import mesh_quality, self_intersections
from smplxpp.metrics.quality import fan_counts


def test_a_sphere_is_perfect(sphere):
    quality = mesh_quality(sphere(1.0, 3), self_intersection=True)
    assert quality.manifold and quality.closed
    assert (quality.components, quality.euler) == (1, 2)
    assert (quality.inconsistent_edges, quality.flipped_faces, quality.zero_area_faces) == (0, 0, 0)
    assert quality.self_intersections == 0
    assert quality.aspect_max < 1.2
    assert quality.area_m2 == pytest.approx(4 * np.pi, rel=0.01)


def test_an_equilateral_triangle_has_aspect_one_and_a_right_one_more():
    equilateral = TriangleMesh([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]], [[0, 1, 2]])
    assert mesh_quality(equilateral).aspect_max == pytest.approx(1.0, rel=1e-12)
    # 3-4-5: circumradius 2.5, inradius 1.
    right = TriangleMesh([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])
    assert mesh_quality(right).aspect_max == pytest.approx(1.25, rel=1e-12)


def test_the_border_of_a_square_is_its_circumference(plane):
    quality = mesh_quality(plane(0.0, half=1.0, cells=8))
    assert (quality.border_edges, quality.border_loops) == (32, 1)
    assert quality.border_lengths_mm == pytest.approx((8000.0,))
    assert quality.euler == 1
    two = mesh_quality(concatenate_meshes([plane(0.0), plane(1.0, half=0.5)]))
    assert two.components == 2
    assert two.border_lengths_mm == pytest.approx((8000.0, 4000.0))


def test_turned_faces_are_counted_against_the_majority(sphere):
    ball = sphere(1.0, 2)
    faces = ball.faces.copy()
    faces[[10, 200]] = faces[[10, 200]][:, ::-1]
    quality = mesh_quality(TriangleMesh(ball.vertices, faces))
    assert quality.flipped_faces == 2
    assert quality.inconsistent_edges == 6
    # All faces turned is consistent: outward or inward is not this test's question.
    assert mesh_quality(TriangleMesh(ball.vertices, ball.faces[:, ::-1])).flipped_faces == 0


def test_defects_are_counted():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [9, 9, 9], [2, 0, 0]]
    fan = TriangleMesh(vertices, [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    quality = mesh_quality(fan)
    assert (quality.nonmanifold_edges, quality.unreferenced_vertices) == (1, 2)
    bow_tie = TriangleMesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]], [[0, 1, 2], [0, 3, 4]])
    assert mesh_quality(bow_tie).nonmanifold_vertices == 1
    assert not mesh_quality(bow_tie).manifold
    flat = TriangleMesh(vertices, [[0, 1, 2], [2, 1, 0], [0, 1, 6]])
    quality = mesh_quality(flat)
    assert (quality.duplicate_faces, quality.zero_area_faces) == (1, 1)


def test_self_intersections_equal_those_of_every_pair_tested():
    rng = np.random.default_rng(0)
    corners = np.repeat(rng.random((150, 3)), 3, axis=0) + rng.normal(0, 0.1, (450, 3))
    soup = TriangleMesh(corners, np.arange(450).reshape(-1, 3))
    found = set(map(tuple, self_intersections(soup)))
    i, j = np.triu_indices(150, 1)
    near = (soup.triangles[i].min(1) <= soup.triangles[j].max(1)).all(1)
    near &= (soup.triangles[j].min(1) <= soup.triangles[i].max(1)).all(1)
    corner = [[np.asfortranarray(c[None]) for c in t] for t in soup.triangles]
    expected = {
        (a, b)
        for a, b in zip(i[near].tolist(), j[near].tolist(), strict=True)
        if igl.tri_tri_intersection_test_3d(*corner[a], *corner[b])[0]
    }
    assert len(expected) > 20
    assert found == expected


def test_two_overlapping_spheres_cut_each_other_and_chunks_do_not_matter(sphere, monkeypatch):
    ball = sphere(1.0, 3)
    both = concatenate_meshes([ball, ball.with_vertices(ball.vertices + [1.0, 0.013, 0.017])])
    pairs = self_intersections(both)
    assert len(pairs) > 20
    assert (pairs[:, 0] < ball.face_count).all() and (pairs[:, 1] >= ball.face_count).all()
    monkeypatch.setattr("smplxpp.metrics.intersections.PAIRS_AT_ONCE", 1_000)
    np.testing.assert_array_equal(self_intersections(both), pairs)


def test_a_huge_face_among_small_ones_is_found(sphere):
    ball = sphere(0.01, 3)
    big = TriangleMesh([[-50, 0.001, -50], [50, 0.001, -50], [0, 0.001, 80]], [[0, 1, 2]])
    pairs = self_intersections(concatenate_meshes([ball, big]))
    y = ball.triangles[:, :, 1]
    crossing = (y.min(1) < 0.001) & (y.max(1) > 0.001)
    np.testing.assert_array_equal(pairs[:, 0], np.flatnonzero(crossing))


def test_an_empty_mesh_is_refused():
    with pytest.raises(InputError, match="area"):
        mesh_quality(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))


def test_fans_agree_with_libigl_on_random_soups():
    rng = np.random.default_rng(0)
    for _ in range(20):
        faces = np.array([rng.choice(12, 3, replace=False) for _ in range(14)])
        used = np.unique(faces)
        np.testing.assert_array_equal(
            (fan_counts(TriangleMesh(np.zeros((12, 3)), faces)) == 1)[used], igl.is_vertex_manifold(faces)[used]
        )
