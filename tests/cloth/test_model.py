"""Constraints of cloth, and how a coarse mesh carries a fine one."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.cloth.embedding import embed
from smplxpp.cloth.model import Fabric, build_model, shuffled
from smplxpp.core import TriangleMesh, matrix_from_rotvec
from tests.cloth.sheets import bent, hanging, held

TURN, SHIFT = matrix_from_rotvec(np.array([0.7, 0.2, -1.3])), np.array([0.4, -2.0, 1.0])


def test_masses_are_the_sheets():
    mesh, fabric = bent(hanging()), Fabric(density=0.3)
    mass = 1.0 / build_model(mesh, np.zeros(35), fabric).inverse_mass.astype(float)
    assert mass.sum() == pytest.approx(0.3 * mesh.face_areas.sum(), rel=1e-5)


def test_shuffled_edges_are_the_same_edges_in_no_order():
    model = build_model(hanging(20, 20), held(hanging(20, 20)), Fabric())
    other = shuffled(model)
    rows = [
        sorted(zip(*(getattr(m, name).tolist() for name in ("edges", "lengths", "stretch", "compress")), strict=True))
        for m in (model, other)
    ]
    assert rows[0] == rows[1]
    assert abs(np.corrcoef(np.arange(len(other.edges)), other.edges.sum(axis=1))[0, 1]) < 0.1
    np.testing.assert_array_equal(shuffled(model).edges, other.edges)


def test_every_edge_that_moves_once_from_what_holds_downwards():
    mesh = bent(hanging())
    model = build_model(mesh, held(mesh), Fabric())
    ends = {tuple(sorted(edge)) for edge in model.edges.tolist()}
    inner = {tuple(edge) for edge in mesh.edges.tolist() if max(edge) >= 5}
    assert ends == inner and len(model.edges) == len(inner)
    depth = mesh.vertices[model.edges][..., 1].mean(axis=1)
    assert np.corrcoef(np.arange(len(depth)), -depth)[0, 1] > 0.95
    chords = np.linalg.norm(np.diff(mesh.vertices[model.edges], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(model.lengths, chords, rtol=1e-6)
    np.testing.assert_allclose(model.compress, model.stretch / Fabric().compression, rtol=1e-5)


def test_lengths_of_its_own_follow_their_edges():
    mesh = bent(hanging())
    own = 1.0 + np.arange(len(mesh.edges))
    model = build_model(mesh, held(mesh), Fabric(), lengths=own)
    places = {tuple(edge): length for edge, length in zip(mesh.edges.tolist(), own, strict=True)}
    np.testing.assert_allclose(model.lengths, [places[tuple(sorted(edge))] for edge in model.edges.tolist()])


def test_stiffness_has_its_unit():
    mesh, model = hanging(), build_model(hanging(), np.zeros(35), Fabric(stretch_stiffness=50.0))
    large = build_model(mesh.with_vertices(100 * mesh.vertices), np.zeros(35), Fabric(stretch_stiffness=50.0))
    np.testing.assert_allclose(large.stretch, model.stretch, rtol=1e-5)  # N/m does not know how large a sheet is
    np.testing.assert_allclose(large.rest_curvature, 100 * model.rest_curvature, atol=1e-6)
    np.testing.assert_allclose(large.bend, 1e4 * model.bend, rtol=1e-5)


def test_hinges_say_nothing_of_where_cloth_lies_and_all_of_how_it_is_bent():
    mesh = bent(hanging())
    moved = mesh.with_vertices(mesh.vertices @ TURN.T + SHIFT)
    one, other, flat = (build_model(m, np.zeros(35), Fabric()) for m in (mesh, moved, hanging()))
    assert len(one.hinges) == len(mesh.edges) - len(mesh.border_edges)
    np.testing.assert_allclose(other.rest_curvature, one.rest_curvature, atol=1e-6)
    np.testing.assert_allclose(one.curvature.sum(axis=1), 0.0, atol=1e-5)  # a shift does nothing
    assert np.abs(flat.rest_curvature).max() < 1e-6 < 1e-3 < np.abs(one.rest_curvature).max()
    assert len(build_model(mesh, np.zeros(35), Fabric(bend_stiffness=0.0)).hinges) == 0


def test_tethers_are_the_shortest_way_to_what_holds():
    mesh = hanging()
    for slack in (0.0, 0.2):
        model = build_model(mesh, held(mesh), Fabric(slack=slack))
        assert (model.anchor[:5] == -1).all() and (model.anchor[5:] < 5).all() and (model.anchor[5:] >= 0).all()
        straight = np.linalg.norm(mesh.vertices[5:] - mesh.vertices[model.anchor[5:]], axis=1)
        assert (model.tether[5:] >= straight - 1e-7).all()
        assert (model.tether[5:] <= (1.01 * straight + 0.001) * (1 + slack) + 1e-6).all()
    assert (build_model(mesh, np.zeros(35), Fabric()).anchor == -1).all()


def test_particles_are_as_far_apart_as_the_nearest_that_no_edge_joins():
    mesh = hanging(cell=0.03)
    folded = mesh.with_vertices(
        np.where(np.arange(35)[:, None] == 34, mesh.vertices[0] + [0.0, 0.0, 0.004], mesh.vertices)
    )
    for sheet in (mesh, folded):
        away = np.linalg.norm(sheet.vertices[:, None] - sheet.vertices[None], axis=2)
        away[tuple(sheet.edges.T)] = away[tuple(sheet.edges[:, ::-1].T)] = np.inf
        np.fill_diagonal(away, np.inf)
        np.testing.assert_allclose(build_model(sheet, held(sheet), Fabric()).apart, away.min(axis=1), rtol=1e-6)
    assert build_model(folded, held(folded), Fabric()).apart[0] == pytest.approx(0.004)
    alone = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    assert np.isinf(build_model(alone, np.zeros(3), Fabric()).apart).all()


def test_nothing_holds_a_piece_of_its_own():
    one = hanging()
    both = TriangleMesh(np.concatenate([one.vertices, one.vertices + 1]), np.concatenate([one.faces, one.faces + 35]))
    model = build_model(both, np.r_[held(one), np.zeros(35)], Fabric())
    assert (model.anchor[35:] == -1).all() and (model.anchor[5:35] >= 0).all()


def test_springs_are_softer_where_less_is_attached():
    mesh, attachment = hanging(), held(hanging())
    attachment[5:10], attachment[10:15] = 0.9, 0.1
    model = build_model(mesh, attachment, Fabric(), attach_stiffness=2.0)
    assert (model.inverse_mass[5:] > 0).all() and (model.inverse_mass[:5] == 0).all()
    assert (model.spring[5:10] < model.spring[10:15]).all() and np.isinf(model.spring[15:]).all()
    assert build_model(mesh, held(mesh), Fabric(), attach_stiffness=2.0).spring is None


def fine_and_coarse() -> tuple[np.ndarray, TriangleMesh]:
    coarse = bent(hanging(), 0.01)
    random = np.random.default_rng(3)
    return bent(hanging(20, 30, 0.008), 0.012).vertices + 0.002 * random.normal(size=(600, 3)), coarse


def test_carried_by_the_mesh_it_was_bound_to_nothing_moves():
    fine, coarse = fine_and_coarse()
    embedding = embed(fine, coarse)
    np.testing.assert_allclose(embedding.weights.sum(axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(embedding.carried(coarse), fine, atol=1e-6)


def test_what_is_carried_turns_with_the_mesh():
    fine, coarse = fine_and_coarse()
    moved = coarse.with_vertices(coarse.vertices @ TURN.T + SHIFT)
    points, normals = embed(fine, coarse).carried_with_normals(moved)
    np.testing.assert_allclose(points, fine @ TURN.T + SHIFT, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(normals, embed(fine, coarse).carried_with_normals(coarse)[1] @ TURN.T, atol=1e-6)


def test_what_is_carried_by_a_bent_mesh_stays_at_its_distance():
    fine, flat = fine_and_coarse()[0] * [1, 1, 0] + [0, 0, 0.004], hanging(5, 7)
    rolled = flat.with_vertices(flat.vertices + [0, 0, 0.01] * np.cos(9 * flat.vertices[:, 1:2]))
    inside = (np.abs(fine[:, 0]) < 0.055) & (fine[:, 1] < -0.005) & (fine[:, 1] > -0.175)
    carried = embed(fine[inside], flat).carried(rolled)
    height = carried[:, 2] - 0.01 * np.cos(9 * carried[:, 1])
    np.testing.assert_allclose(height, 0.004, atol=0.0015)


def test_a_vertex_beside_another_layer_was_drawn_along_by_that():
    """Legs of wide trousers hang side by side: edges from one to the other were drawn to 38 times their length."""
    sheet = hanging(4, 4, 0.03)
    n = sheet.vertex_count
    both = TriangleMesh(
        np.concatenate([sheet.vertices, sheet.vertices + [0, 0, 0.006]]), np.concatenate([sheet.faces, sheet.faces + n])
    )
    # Vertices of the first sheet that lie nearer to the second one.
    points, cell = sheet.vertices + [0.004, -0.002, 0.004], np.arange(n)
    apart = both.with_vertices(both.vertices + [0, 0, 0.2] * (np.arange(2 * n) >= n)[:, None])
    assert (embed(points, both).carried(apart)[:, 2] > 0.1).any()
    np.testing.assert_allclose(embed(points, both, cell=cell).carried(apart), points, atol=1e-6)
    # Without a vertex along the cloth the nearest triangle has to do.
    np.testing.assert_array_equal(embed(points, both, cell=0 * cell - 1).corners, embed(points, both).corners)


def test_triangles_without_area_carry_without_nan():
    needle = TriangleMesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    points = np.array([[0.5, 0.1, 0.0], [3.0, 0.0, 1.0]])
    assert np.isfinite(embed(points, needle).carried(needle)).all()
