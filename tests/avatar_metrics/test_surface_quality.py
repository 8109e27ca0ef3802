"""Surfaces by their convention: nothing off is 0, a shift is its length, hidden layers do not count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from avatar.metrics.surface_quality import SurfaceQuality, mean_surface, surface_quality, surface_spread
from smplxpp.core import LOWER, SKIN, UPPER, InputError, TriangleMesh, concatenate_meshes

SAMPLES = 4000


def plate(*, z: float = 0.0, x: float = 0.0) -> TriangleMesh:
    """A metre square of 5 cm faces, facing +z."""
    k = np.arange(21) / 20.0
    xx, yy = np.meshgrid(k, k, indexing="ij")
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    a, b, c, d = corner, corner + 21, corner + 22, corner + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return TriangleMesh(np.stack([xx.ravel() + x, yy.ravel(), np.full(441, z)], 1), faces)


def measured(mesh: TriangleMesh, truth: TriangleMesh, labels: np.ndarray | None = None) -> SurfaceQuality:
    labels = np.full(mesh.vertex_count, UPPER.id) if labels is None else labels
    return surface_quality(mesh, labels, truth, samples=SAMPLES)


def test_a_mesh_on_itself_is_nothing_off():
    quality = measured(plate(), plate())
    assert max(quality.p2s, quality.truth_to_mesh, quality.chamfer, quality.p95) < 1e-9
    assert set(quality.labels) == {"upper"} and quality.labels["upper"].p2s < 1e-9


def test_a_shift_is_its_length_in_mm():
    quality = measured(plate(z=0.007), plate())
    assert quality.p2s == pytest.approx(7.0) and quality.truth_to_mesh == pytest.approx(7.0)
    assert quality.chamfer == pytest.approx(7.0) and quality.p95 == pytest.approx(7.0)


def test_what_is_missing_shows_in_the_other_direction():
    whole = plate()
    half = whole.submesh(whole.face_centers[:, 0] < 0.5)[0]
    quality = measured(half, whole)
    # Half of the truth is off by 0 to 500 mm along x.
    assert quality.p2s < 1e-9 and quality.truth_to_mesh == pytest.approx(125.0, rel=0.02)
    assert quality.chamfer == pytest.approx(quality.truth_to_mesh / 2)


def test_labels_are_measured_apart_against_the_whole_truth():
    left, right = plate(), plate(x=2.0, z=0.01)
    labels = np.repeat([UPPER.id, LOWER.id], left.vertex_count)
    truth = concatenate_meshes([plate(), plate(x=2.0)])
    quality = measured(concatenate_meshes([left, right]), truth, labels)
    assert quality.labels["upper"].p2s < 1e-9
    assert quality.labels["lower"].p2s == pytest.approx(10.0) == quality.labels["lower"].truth_to_mesh
    assert quality.p2s == pytest.approx(5.0, rel=0.02)


def test_what_no_view_sees_does_not_count():
    outer, inner = trimesh.creation.icosphere(subdivisions=4), trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    outer, inner = (TriangleMesh(m.vertices, m.faces) for m in (outer, inner))
    labels = np.repeat([UPPER.id, SKIN.id], outer.vertex_count)
    quality = measured(concatenate_meshes([outer, inner]), outer, labels)
    assert quality.p2s < 1e-9 and "skin" not in quality.labels


def test_moving_both_changes_nothing():
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    one, other = plate(z=0.003), plate()
    moved = [mesh.with_vertices(mesh.vertices @ turn.T + (1.0, -2.0, 0.5)) for mesh in (one, other)]
    assert measured(*moved).p2s == pytest.approx(measured(one, other).p2s)


def test_means_are_over_the_frames_that_have_a_figure():
    frames = [
        SurfaceQuality(2.0, 4.0, 3.0, 5.0, {"upper": SurfaceQuality(1.0, None, None, 2.0)}),
        SurfaceQuality(4.0, 6.0, 5.0, 9.0, {"lower": SurfaceQuality(7.0, 1.0, 4.0, 8.0)}),
    ]
    mean = mean_surface(frames)
    assert (mean.p2s, mean.truth_to_mesh, mean.chamfer, mean.p95) == (3.0, 5.0, 4.0, 7.0)
    assert mean.labels == {"upper": frames[0].labels["upper"], "lower": frames[1].labels["lower"]}
    with pytest.raises(InputError, match="one frame"):
        mean_surface([])


def test_the_head_is_a_region_beside_the_labels():
    left, right = plate(), plate(x=2.0, z=0.01)
    truth = concatenate_meshes([plate(), plate(x=2.0)])
    mesh = concatenate_meshes([left, right])
    labels = np.full(mesh.vertex_count, SKIN.id)
    head = np.arange(mesh.face_count) >= left.face_count
    quality = surface_quality(mesh, labels, truth, head=head, samples=SAMPLES)
    assert set(quality.labels) == {"skin", "head"}
    assert quality.labels["head"].p2s == pytest.approx(10.0) == quality.labels["head"].truth_to_mesh
    assert quality.labels["skin"].p2s == quality.p2s == pytest.approx(5.0, rel=0.02)
    plain = surface_quality(mesh, labels, truth, samples=SAMPLES)
    assert plain == replace(quality, labels={"skin": quality.labels["skin"]})


def test_spread_is_a_standard_deviation_over_frames():
    frames = [
        SurfaceQuality(2.0, 4.0, 3.0, 5.0, {"upper": SurfaceQuality(1.0, None, None, 2.0)}),
        SurfaceQuality(4.0, 4.0, 4.0, 9.0, {"lower": SurfaceQuality(7.0, 1.0, 4.0, 8.0)}),
    ]
    spread = surface_spread(frames)
    assert spread.p2s == pytest.approx(2.0 / np.sqrt(2.0)) and spread.truth_to_mesh == 0.0
    assert spread.labels["upper"].p2s is None and spread.labels["lower"].chamfer is None
