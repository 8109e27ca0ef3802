"""Isotropic remeshing of parts, where pymeshlab is installed, and what is said where it is not."""

from __future__ import annotations

import sys

import igl
import numpy as np
import pytest

from smplxpp.clean import PartsConfig, clean_parts, loop_lengths, remesh
from smplxpp.core import UPPER, GeometryWarning, InputError, MissingExtraError, TriangleMesh
from smplxpp.core.topology import border_loops
from smplxpp.metrics import point_to_surface
from tests.clean.test_parts import tube


def rounded(mesh: TriangleMesh) -> np.ndarray:
    """How near each face is to equal sides: 1 is there, 0 a needle."""
    sides = mesh.triangles - np.roll(mesh.triangles, 1, axis=1)
    return 4 * 3**0.5 * mesh.face_areas / (sides**2).sum(axis=(1, 2))


def stretched() -> TriangleMesh:
    """A sleeve whose faces are three times longer than wide."""
    return tube(40, 200)


def test_without_pymeshlab_it_says_what_to_type(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    sleeve = tube()
    with pytest.raises(MissingExtraError, match=r"pip install .*extra remesh"):
        remesh(sleeve, 1000)
    labels = np.full(sleeve.face_count, UPPER.id)
    with pytest.raises(MissingExtraError, match="isotropic remeshing needs pymeshlab"):
        clean_parts(sleeve, labels, config=PartsConfig(method="isotropic"))
    assert clean_parts(sleeve, labels)["upper"].report.faces_before == sleeve.face_count


def test_an_unknown_method_is_refused():
    with pytest.raises(InputError, match="method"):
        PartsConfig(method="isometric")


@pytest.mark.parametrize("budget", [1500, 6000, 10**6])
def test_faces_of_equal_sides_within_the_budget_on_the_same_surface(budget: int):
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    sleeve = stretched()
    result = remesh(sleeve, budget)
    mesh = result.mesh
    assert 0.95 < mesh.face_count / min(budget, sleeve.face_count) < 1.05
    assert igl.is_edge_manifold(mesh.faces)[0] and igl.is_vertex_manifold(mesh.faces).all()
    assert result.flipped_faces == 0 and len(np.unique(mesh.vertices, axis=0)) == mesh.vertex_count
    assert rounded(mesh).mean() > rounded(sleeve).mean() + 0.25
    assert point_to_surface(mesh.vertices, sleeve)[0].max() < 1.5e-3
    assert point_to_surface(sleeve.vertices, mesh)[0].max() < 1.5e-3
    lengths = [sorted(loop_lengths(m, border_loops(m.faces))) for m in (sleeve, mesh)]
    np.testing.assert_allclose(*lengths, rtol=0.01)
    edge = np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1), axis=2).max()
    assert np.linalg.norm(sleeve.vertices[result.source_vertex] - mesh.vertices, axis=1).max() < edge
    assert np.linalg.norm(mesh.vertices[result.new_from_old] - sleeve.vertices, axis=1).max() < edge


def test_bit_for_bit_and_moved_with_the_surface():
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    first, second = remesh(stretched(), 2000).mesh, remesh(stretched(), 2000).mesh
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)
    larger = remesh(stretched().with_vertices(1000.0 * stretched().vertices), 2000).mesh
    assert larger.face_count == pytest.approx(first.face_count, rel=0.02)


def test_a_crumpled_surface_keeps_its_budget():
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    sleeve = tube()
    crumpled = sleeve.with_vertices(sleeve.vertices + np.random.default_rng(0).normal(0, 4e-3, sleeve.vertices.shape))
    result = remesh(crumpled, 400)
    assert 380 <= result.mesh.face_count <= 420 and igl.is_edge_manifold(result.mesh.faces)[0]


def test_pieces_that_need_more_faces_than_the_budget_are_said():
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    sleeve, count = tube(), 20
    many = TriangleMesh(
        np.concatenate([sleeve.vertices + [k, 0, 0] for k in range(count)]),
        np.concatenate([sleeve.faces + k * sleeve.vertex_count for k in range(count)]),
    )
    with pytest.warns(GeometryWarning, match="where 20 were asked for"):
        assert remesh(many, 20).mesh.face_count > 21


def test_colours_of_parts_follow():
    pytest.importorskip("pymeshlab", exc_type=ImportError)
    sleeve = tube()
    colors = np.round(255 * (sleeve.vertices - sleeve.vertices.min(0)) / np.ptp(sleeve.vertices, axis=0))
    config = PartsConfig(face_budgets={"upper": 1500}, method="isotropic")
    labels = np.full(sleeve.face_count, UPPER.id)
    part = clean_parts(sleeve, labels, config=config, vertex_colors=colors.astype(np.uint8))["upper"]
    expected = 255 * (part.mesh.vertices - sleeve.vertices.min(0)) / np.ptp(sleeve.vertices, axis=0)
    assert part.vertex_colors is not None and np.abs(part.vertex_colors - expected).max() < 20
    assert part.report.non_manifold_edges == 0 and part.report.faces_after == part.mesh.face_count
