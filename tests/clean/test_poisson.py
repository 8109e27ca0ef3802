"""Surfaces of clouds of points."""

from __future__ import annotations

import sys
import warnings

import numpy as np
import pytest

from smplxpp.clean.poisson import FEWEST_POINTS, PoissonConfig, surface_from_points
from smplxpp.core import GeometryWarning, InputError, MissingExtraError, TriangleMesh
from smplxpp.metrics import mesh_quality, point_to_surface, sample_surface


def ball(radius: float = 0.5) -> TriangleMesh:
    import trimesh

    it = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return TriangleMesh(it.vertices, it.faces)


def quiet(points: np.ndarray, normals: np.ndarray | None = None, **options):
    pytest.importorskip("open3d", exc_type=ImportError)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        return surface_from_points(points, normals, **options)


def test_without_open3d_it_says_what_to_type(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*extra scan"):
        surface_from_points(np.zeros((1000, 3)))


def test_a_ball_of_points_is_a_closed_ball_bit_for_bit():
    points = sample_surface(ball(), 20000, seed=0).points
    surface = quiet(points)
    quality = mesh_quality(surface.mesh)
    assert quality.closed and quality.manifold and quality.components == 1
    radius = np.linalg.norm(surface.mesh.vertices, axis=1)
    assert abs(radius.mean() - 0.5) < 5e-4 and radius.std() < 2e-3
    outward = np.einsum("ij,ij->i", surface.mesh.face_normals, surface.mesh.face_centers)
    assert (outward > 0).all()
    again = quiet(points)
    np.testing.assert_array_equal(again.mesh.vertices, surface.mesh.vertices)
    np.testing.assert_array_equal(again.mesh.faces, surface.mesh.faces)


def test_a_wide_hole_stays_open_and_no_bubble_closes_it():
    samples = sample_surface(ball(), 20000, seed=0)
    kept = samples.points[:, 1] < 0.35
    surface = quiet(samples.points[kept], samples.normals[kept])
    assert surface.mesh.vertices[:, 1].max() < 0.38
    assert len(mesh_quality(surface.mesh).border_lengths_mm) == 1
    assert point_to_surface(surface.mesh.vertices, ball())[0].max() < 0.01


@pytest.mark.parametrize(("sign", "words"), [(1, "normals of the file;"), (-1, "inward"), (0, "normals estimated:")])
def test_normals_of_a_file_are_taken_turned_or_left(sign: int, words: str):
    pytest.importorskip("open3d", exc_type=ImportError)
    samples = sample_surface(ball(), 5000, seed=0)
    signs = np.random.default_rng(0).choice([-1, 1], size=(5000, 1)) if sign == 0 else sign
    with pytest.warns(GeometryWarning, match=words):
        surface = surface_from_points(samples.points, samples.normals * 3.0 * signs)
    assert np.einsum("ij,ij->i", surface.mesh.face_normals, surface.mesh.face_centers).min() > 0


def test_damaged_repeated_and_stray_points_are_left_out_and_vertices_keep_their_points():
    samples = sample_surface(ball(), 8000, seed=0)
    points = np.concatenate([[[np.nan, 0, 0], [3.0, 0, 0], [3.0, 0, 0.001]], samples.points, samples.points[:100]])
    surface = quiet(points)
    assert "103 points left out" in surface.note
    assert np.abs(surface.mesh.vertices).max() < 0.6
    distance = np.linalg.norm(points[surface.source_point] - surface.mesh.vertices, axis=1)
    assert distance.max() < 0.05 and (surface.source_point > 2).all()


def test_too_few_points_and_bad_options_are_refused():
    with pytest.raises(InputError, match="at least"):
        quiet(sample_surface(ball(), FEWEST_POINTS - 1, seed=0).points)
    with pytest.raises(InputError, match="depth"):
        PoissonConfig(depth=20)
    with pytest.raises(InputError, match="reach"):
        PoissonConfig(reach=0.5)
