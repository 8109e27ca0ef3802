from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.core.mesh import cross_rows


@pytest.fixture(scope="module")
def oracle() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=0.7)


@pytest.fixture(scope="module")
def sphere(oracle) -> TriangleMesh:
    return TriangleMesh(oracle.vertices, oracle.faces)


def test_areas_and_normals_equal_trimesh(sphere, oracle):
    np.testing.assert_allclose(sphere.face_areas, oracle.area_faces, rtol=1e-12)
    np.testing.assert_allclose(sphere.face_normals, oracle.face_normals, atol=1e-12)


@pytest.mark.parametrize("rows", [0, 1, 2, 7, 1000])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_cross_products_of_rows_are_numpys_bit_for_bit(rows, dtype):
    a, b = np.random.default_rng(rows).normal(size=(2, rows, 3)).astype(dtype)
    for other in (b, np.arange(3, dtype=dtype)):
        found, truth = cross_rows(a, other), np.cross(a, other)
        assert found.dtype == truth.dtype and np.array_equal(found, truth)


def test_vertex_normals_of_a_sphere_are_radial(sphere):
    radial = sphere.vertices / 0.7
    assert np.abs(np.einsum("ij,ij->i", sphere.vertex_normals, radial) - 1).max() < 1e-3


def test_angle_weighted_normal_does_not_depend_on_the_triangulation():
    # A cube corner: whatever diagonals split its faces, the corner's normal is the diagonal of the cube.
    box = trimesh.creation.box()
    mesh = TriangleMesh(box.vertices, box.faces)
    expected = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.vertex_normals, expected, atol=1e-12)


def test_edges_close_a_closed_surface(sphere):
    edges, counts = sphere.edges_with_counts
    assert (counts == 2).all()
    assert sphere.vertex_count - len(edges) + sphere.face_count == 2
    assert len(sphere.border_edges) == 0


def test_submesh_keeps_positions_and_border(sphere):
    part, ids = sphere.submesh(sphere.triangles[:, :, 1].min(axis=1) > 0)
    np.testing.assert_array_equal(part.vertices, sphere.vertices[ids])
    assert len(part.border_edges) > 0
    assert part.face_count < sphere.face_count


def test_concatenate_then_submesh_returns_the_pieces(sphere):
    both = concatenate_meshes([sphere, sphere.with_vertices(sphere.vertices + 5)])
    second, _ = both.submesh(np.arange(sphere.face_count, both.face_count))
    np.testing.assert_array_equal(second.vertices, sphere.vertices + 5)
    np.testing.assert_array_equal(second.faces, sphere.faces)


def test_a_mesh_cannot_be_changed_behind_its_cache(sphere):
    with pytest.raises(ValueError, match="read-only"):
        sphere.vertices[0] = 0


def test_unreferenced_vertices_do_not_count_for_the_size(sphere):
    far = TriangleMesh(np.vstack([sphere.vertices, [[100.0, 0, 0]]]), sphere.faces)
    assert far.bbox_diagonal == pytest.approx(sphere.bbox_diagonal)


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], r"shape \(N, 3\), received shape \(3, 2\)"),
        (np.zeros((3, 3)), [[0, 1, 2, 0]], "Triangulate"),
        (np.zeros((3, 3)), [[0.0, 1.0, 2.0]], "integers"),
        (np.zeros((3, 3)), [[1, 2, 3]], "1-based"),
        ([[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]], [[0, 1, 2]], "first at index 1"),
    ],
)
def test_bad_input_names_what_was_received(vertices, faces, words):
    with pytest.raises(InputError, match=words):
        TriangleMesh(vertices, faces)


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 6), st.integers(0, 4)), elements=st.floats(width=64)),
    hnp.arrays(np.int64, st.tuples(st.integers(0, 5), st.integers(0, 4)), elements=st.integers(-3, 8)),
)
def test_any_arrays_make_a_mesh_or_an_input_error(vertices, faces):
    try:
        mesh = TriangleMesh(vertices, faces)
    except InputError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert not mesh.faces.size or mesh.faces.max() < mesh.vertex_count
