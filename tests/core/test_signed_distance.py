"""Signed distance: spheres, open sheets, overlapping solids, and libigl as the oracle."""

from __future__ import annotations

import inspect
import subprocess
import sys
import textwrap

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from smplxpp.core import InputError, TriangleMesh, concatenate_meshes
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates


def sphere(radius: float = 1.0, center=(0.0, 0.0, 0.0), subdivisions: int = 3) -> TriangleMesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriangleMesh(np.asarray(ball.vertices) + center, np.asarray(ball.faces))


def sheet(n: int = 8) -> TriangleMesh:
    """The unit square at z = 0, facing +z."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return TriangleMesh(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), faces)


@pytest.mark.parametrize("solid", [True, False])
def test_sphere_agrees_with_libigl_and_the_formula(solid):
    mesh, points = sphere(), np.random.default_rng(0).normal(0, 0.8, (500, 3))
    found = SignedDistanceField(mesh, solid=solid).query(points)
    oracle = igl.signed_distance(points, mesh.vertices, mesh.faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
    assert np.allclose(found.distance, oracle, atol=1e-12)
    assert np.allclose(found.distance, np.linalg.norm(points, axis=1) - 1.0, atol=0.02)
    assert not found.on_border.any()


def test_points_whose_side_is_not_asked_count_as_outside():
    points = np.random.default_rng(3).normal(0, 0.8, (500, 3))
    field, asked = SignedDistanceField(sphere(), solid=True), np.arange(500) % 2 == 0
    whole, some = field.query(points), field.query(points, sided=asked)
    assert (whole.distance[~asked] < 0).any()
    assert np.array_equal(some.distance, np.where(asked, whole.distance, np.abs(whole.distance)))


@pytest.mark.parametrize("solid", [True, False])
def test_gradient_leads_to_the_asked_distance(solid):
    mesh, points = sphere(), np.random.default_rng(1).normal(0, 0.8, (300, 3))
    field = SignedDistanceField(mesh, solid=solid)
    found = field.query(points)
    there = points + (0.01 - found.distance)[:, None] * found.gradient
    assert np.allclose(field.query(there).distance, 0.01, atol=1e-9)


def test_solids_that_are_remembered_are_not_taken_for_each_other(monkeypatch):
    """The same vertices with other faces are another solid; one asked of again is computed once."""
    whole, points = sphere(), np.random.default_rng(2).normal(0, 0.8, (200, 3))
    open_ball = TriangleMesh(whole.vertices, whole.faces[whole.face_centers[:, 1] < 0.5])
    solids = [sphere(radius) for radius in np.linspace(0.5, 1.5, 8)] + [whole, open_ball]
    first = [SignedDistanceField(one, solid=True).query(points).distance for one in solids]
    monkeypatch.setattr("smplxpp.core.signed_distance._SOLIDS", {})
    monkeypatch.setattr(SignedDistanceField, "_unburied", inspect.unwrap(SignedDistanceField._unburied))
    within, calls = SignedDistanceField._inside, []
    monkeypatch.setattr(SignedDistanceField, "_inside", lambda self, p: (calls.append(len(p)), within(self, p))[1])
    for mesh, distance in zip(solids, first, strict=True):
        for _ in range(2):
            np.testing.assert_array_equal(SignedDistanceField(mesh, solid=True).query(points).distance, distance)
    assert [calls.count(mesh.face_count) for mesh in (open_ball, whole)] == [1, 9]


def test_points_on_the_surface_get_its_normal():
    mesh = sphere()
    found = SignedDistanceField(mesh, solid=False).query(mesh.vertices)
    assert np.abs(found.distance).max() < 1e-12
    assert np.allclose(found.gradient, mesh.vertex_normals, atol=1e-9)


def test_a_sheet_has_sides_but_not_beside_its_border():
    found = SignedDistanceField(sheet(), solid=False).query(
        np.array([[0.5, 0.4, 0.1], [0.5, 0.4, -0.1], [-0.2, 0.5, 0.01], [1.3, 1.4, -0.01]])
    )
    assert np.allclose(found.distance[:2], [0.1, -0.1])
    assert found.on_border.tolist() == [False, False, True, True]


def test_overlapping_solids_are_one():
    union = concatenate_meshes([sphere(center=(-0.5, 0, 0)), sphere(center=(0.5, 0, 0)), sphere(0.2, (0.9, 0, 0))])
    field = SignedDistanceField(union, solid=True)
    # In one ball, just outside the other: the other's surface is no way out.
    found = field.query(np.array([[-0.52, 0.0, 0.0], [0.9, 0.0, 0.0], [0.0, 2.0, 0.0]]))
    assert found.distance[0] < -0.85
    assert found.distance[1] == pytest.approx(-0.6, abs=0.03)
    assert found.distance[2] > 1.0


def test_a_hole_does_not_turn_the_inside_out():
    mesh = sphere()
    opened = TriangleMesh(mesh.vertices, mesh.faces[mesh.triangles.mean(axis=1)[:, 1] < 0.97])
    points = np.random.default_rng(2).normal(0, 1, (400, 3))
    points = points[np.abs(np.linalg.norm(points, axis=1) - 1) > 0.05]
    signs = np.sign(SignedDistanceField(opened, solid=True).query(points).distance)
    assert (signs == np.sign(np.linalg.norm(points, axis=1) - 1)).all()


@pytest.mark.parametrize("solid", [True, False])
def test_rigid_motion_and_unit(solid):
    mesh, points = sphere(), np.random.default_rng(3).normal(0, 0.8, (200, 3))
    turn = Rotation.from_euler("xyz", [0.5, 1.0, -2.0]).as_matrix()
    before = SignedDistanceField(mesh, solid=solid).query(points).distance
    moved = TriangleMesh(1000 * (mesh.vertices @ turn.T) + 5, mesh.faces)
    after = SignedDistanceField(moved, solid=solid).query(1000 * (points @ turn.T) + 5).distance
    assert np.allclose(after, 1000 * before, rtol=1e-9, atol=1e-6)


def test_zero_area_faces_are_left_out():
    mesh = sphere()
    faces = np.concatenate([[[0, 0, 1]], mesh.faces])
    found = SignedDistanceField(TriangleMesh(mesh.vertices, faces), solid=False).query(np.array([[0.0, 0.0, 2.0]]))
    assert found.distance[0] == pytest.approx(1.0, abs=0.02)
    assert found.face[0] > 0


def test_barycentric_coordinates_give_the_point_back():
    rng = np.random.default_rng(4)
    triangles, bary = rng.normal(size=(50, 3, 3)), rng.dirichlet(np.ones(3), 50)
    points = np.einsum("nk,nkd->nd", bary, triangles)
    assert np.allclose(barycentric_coordinates(points, triangles), bary, atol=1e-9)


def test_bad_input():
    mesh = sphere(subdivisions=1)
    with pytest.raises(InputError, match="point inward"):
        SignedDistanceField(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]), solid=True)
    with pytest.raises(InputError, match="have an area"):
        SignedDistanceField(TriangleMesh(mesh.vertices, mesh.faces[:0]), solid=True)
    with pytest.raises(InputError, match="query points"):
        SignedDistanceField(mesh, solid=True).query(np.full((1, 3), np.nan))
    assert len(SignedDistanceField(mesh, solid=True).query(np.zeros((0, 3))).distance) == 0


@pytest.mark.long
def test_a_process_that_asked_of_a_solid_ends_without_a_word():
    """Bindings that outlive the interpreter are reported as leaks, below the answer of a command."""
    script = """
        import ctypes, trimesh
        from smplxpp.core import TriangleMesh
        from smplxpp.core import signed_distance
        from smplxpp.core.signed_distance import SignedDistanceField
        made = trimesh.creation.icosphere(subdivisions=1)
        mesh = TriangleMesh(made.vertices, made.faces)
        assert SignedDistanceField(mesh, solid=True).query([[2.0, 0.0, 0.0]]).distance[0] > 0.9
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(signed_distance._SOLIDS))  # as a library may that never lets go
    """
    ran = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, timeout=900, check=True
    )
    assert ran.stdout + ran.stderr == ""
