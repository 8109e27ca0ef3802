"""Vertices where the faces lie nearest to the surface that they stand for."""

from __future__ import annotations

import numpy as np

from smplxpp.clean import simplify
from smplxpp.clean.remesh import fit_to_source
from smplxpp.core.mesh import TriangleMesh
from smplxpp.metrics import point_to_surface
from tests.clean.test_parts import tube


def drawn_back(sleeve: TriangleMesh, budget: int) -> TriangleMesh:
    """A coarse mesh with its vertices on the source."""
    small = simplify(sleeve, budget)
    return small.mesh.with_vertices(sleeve.vertices[small.source_vertex])


def distance(source: TriangleMesh, mesh: TriangleMesh) -> float:
    return float(np.sqrt((point_to_surface(source.vertices, mesh)[0] ** 2).mean()))


def test_faces_come_nearer_borders_stay_and_none_turns():
    sleeve = tube()
    coarse = drawn_back(sleeve, 300)
    made = fit_to_source(coarse, sleeve)
    assert distance(sleeve, made) < 0.7 * distance(sleeve, coarse)
    border = np.unique(coarse.border_edges)
    np.testing.assert_array_equal(made.vertices[border], coarse.vertices[border])
    assert not np.array_equal(made.vertices, coarse.vertices)
    assert np.einsum("ij,ij->i", made.face_normals, coarse.face_normals).min() > 0


def test_the_unit_and_the_pose_do_not_matter():
    sleeve = tube()
    coarse = drawn_back(sleeve, 300)
    turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    moved = fit_to_source(*(m.with_vertices(1e3 * m.vertices @ turn.T + [5, 6, 7]) for m in (coarse, sleeve)))
    expected = 1e3 * fit_to_source(coarse, sleeve).vertices @ turn.T + [5, 6, 7]
    np.testing.assert_allclose(moved.vertices, expected, atol=1e-3)  # a point on an edge has two nearest faces


def test_a_mesh_without_free_vertices_stays():
    triangle = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(fit_to_source(triangle, triangle).vertices, triangle.vertices)
