"""Noise of a scan: measured, smoothed where it is too much to build from, and left alone elsewhere."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import trimesh

from smplxpp.clean import ROUGH, roughness, smooth_if_rough
from smplxpp.core import GeometryWarning, TriangleMesh
from tests.clean.test_parts import tube


def ball(level: int = 5) -> TriangleMesh:
    """A ball of 1 m radius."""
    made = trimesh.creation.icosphere(subdivisions=level)
    return TriangleMesh(made.vertices, made.faces)


def noisy(mesh: TriangleMesh, sigma: float) -> TriangleMesh:
    """Normally distributed noise of `sigma` metres on every coordinate."""
    return mesh.with_vertices(mesh.vertices + np.random.default_rng(0).normal(0.0, sigma, mesh.vertices.shape))


def test_roughness_is_the_noise_over_the_edge_and_no_curvature():
    edge = float(np.median(np.linalg.norm(np.diff(ball().vertices[ball().edges], axis=1), axis=2)))
    assert roughness(ball()) < 0.005
    assert roughness(ball(2)) < 0.02  # coarse, but smooth
    # A height less the mean of six, twice: sigma * sqrt(1 + 6/36) and the neighbours' share on top.
    assert roughness(noisy(ball(), 0.1 * edge)) == pytest.approx(0.13, abs=0.03)


def test_a_clean_scan_stays_bit_for_bit():
    mesh = noisy(ball(), 0.002)
    assert roughness(mesh) < ROUGH
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = smooth_if_rough(mesh)
    assert result.mesh is mesh and result.steps == 0 and result.moved == 0.0


def test_a_noisy_ball_comes_nearer_to_the_ball_and_does_not_shrink():
    mesh = noisy(ball(), 0.02)
    with pytest.warns(GeometryWarning, match="smoothed"):
        result = smooth_if_rough(mesh)
    before, after = (np.linalg.norm(m.vertices, axis=1) - 1.0 for m in (mesh, result.mesh))
    assert np.sqrt(np.mean(after**2)) < 0.4 * np.sqrt(np.mean(before**2))
    assert abs(after.mean()) < 0.003
    outward = np.einsum("ij,ij->i", result.mesh.face_normals, result.mesh.face_centers)
    assert (np.einsum("ij,ij->i", mesh.face_normals, mesh.face_centers) < 0).any() and (outward > 0).all()
    assert result.roughness > ROUGH and roughness(result.mesh) < 0.06
    assert result.moved == pytest.approx(0.02 * np.sqrt(3), rel=0.3)


def test_the_rim_of_an_open_scan_stays_a_rim():
    sleeve = tube(120, 160)
    with pytest.warns(GeometryWarning, match="smoothed"):
        result = smooth_if_rough(noisy(sleeve, 0.003))
    rim = sleeve.vertices[:, 1] == 0.0
    assert np.abs(result.mesh.vertices[rim, 1]).mean() < 0.002
    # It is no longer drawn into the sleeve than the noise moved it.
    assert abs(result.mesh.vertices[rim, 1].mean()) < 0.001
