"""The mesh that is simulated: coarse, oriented, its border kept; lengths along the cloth; openings."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.cloth.cloth_mesh import (
    coarsen,
    geodesics,
    largest_piece,
    lengths_along,
    looks_inwards,
    loop_length,
    opening_axis,
    turned_over,
)
from smplxpp.core import TriangleMesh, matrix_from_rotvec
from smplxpp.core.topology import border_loops
from tests.cloth.sheets import ball, bent, grid, hanging

TURN = matrix_from_rotvec(np.array([0.4, -1.0, 0.3]))


def tube(around: int = 40, down: int = 24) -> TriangleMesh:
    """An open cylinder of radius 0.15 about the vertical, 0.4 m high, facing out."""
    angle = 2 * np.pi * np.arange(around) / around
    rings = [
        np.stack([0.15 * np.sin(angle), 0 * angle - y, 0.15 * np.cos(angle)], 1) for y in np.linspace(0, 0.4, down)
    ]
    a = (np.arange(down - 1)[:, None] * around + np.arange(around)).ravel()
    b = (np.arange(down - 1)[:, None] * around + (np.arange(around) + 1) % around).ravel()
    faces = np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    return TriangleMesh(np.concatenate(rings), faces)


def test_few_vertices_cover_the_mesh_at_the_spacing_and_look_its_way():
    mesh = tube()
    seeds, faces = coarsen(mesh, 0.05)
    coarse = TriangleMesh(mesh.vertices[seeds], faces)
    lengths = np.linalg.norm(np.diff(coarse.vertices[coarse.edges], axis=1)[:, 0], axis=1)
    assert np.median(lengths) == pytest.approx(0.05, rel=0.2) and lengths.max() < 0.12
    assert coarse.face_areas.sum() == pytest.approx(mesh.face_areas.sum(), rel=0.05)
    out = np.einsum("fi,fi->f", coarse.face_normals, coarse.face_centers * [1, 0, 1])
    assert (out > 0).all()
    assert len(np.unique(faces)) == len(seeds)
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)


def test_borders_stay_where_they_are():
    mesh = tube()
    seeds, faces = coarsen(mesh, 0.05)
    coarse = TriangleMesh(mesh.vertices[seeds], faces)
    loops = sorted(border_loops(faces), key=lambda loop: -coarse.vertices[loop][:, 1].mean())
    assert len(loops) == 2
    for loop, height in zip(loops, (0.0, -0.4), strict=True):
        np.testing.assert_allclose(coarse.vertices[loop][:, 1], height, atol=1e-12)
        assert loop_length(coarse, loop) == pytest.approx(2 * np.pi * 0.15, rel=0.03)


def test_a_unit_of_length_does_not_decide_which_vertices_stay():
    mesh = bent(hanging(15, 20, 0.02))
    one, other = coarsen(mesh, 0.06), coarsen(mesh.with_vertices(1024.0 * mesh.vertices), 1024.0 * 0.06)
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])


@pytest.mark.parametrize("spacing", [1e-4, 10.0])
def test_any_spacing_gives_a_mesh(spacing):
    mesh = tube()
    seeds, faces = coarsen(mesh, spacing)
    assert len(faces) and faces.max() < len(seeds) <= mesh.vertex_count
    if spacing < 0.01:
        assert len(seeds) == mesh.vertex_count and len(faces) == mesh.face_count


def test_lengths_along_cloth_are_never_below_the_chord_and_right_on_a_cylinder():
    mesh = tube(160, 6)
    quarter, straight = 40, 5 * 160
    lengths = lengths_along(mesh, np.array([[0, quarter], [0, straight], [7, 8]]))
    assert lengths[0] == pytest.approx(0.15 * np.pi / 2, rel=0.01)
    assert lengths[1] == pytest.approx(0.4, abs=1e-9)
    rough = bent(hanging(15, 20, 0.02), 0.03)
    ends = np.random.default_rng(0).integers(0, rough.vertex_count, (200, 2))
    chords = np.linalg.norm(rough.vertices[ends[:, 0]] - rough.vertices[ends[:, 1]], axis=1)
    assert (lengths_along(rough, ends) >= chords - 1e-9).all()
    with_units = lengths_along(rough.with_vertices(1000 * rough.vertices @ TURN.T), ends)
    np.testing.assert_allclose(with_units, 1000 * lengths_along(rough, ends), rtol=1e-6)


def test_ways_along_edges_and_pieces_that_no_way_leads_to():
    mesh = hanging(3, 5)
    both = TriangleMesh(
        np.concatenate([mesh.vertices, mesh.vertices + 1]), np.concatenate([mesh.faces, mesh.faces + 15])
    )
    distance, source = geodesics(both, np.array([0, 2]))
    np.testing.assert_allclose(distance[:3], [0, 0.03, 0])
    assert distance[12] == pytest.approx(0.12) and source[12] == 0 and source[14] == 2
    assert np.isinf(distance[15:]).all() and (source[15:] == -1).all()


def test_the_largest_piece_by_area():
    small, large = hanging(3, 5, 0.01), hanging(3, 3, 0.1)
    both = TriangleMesh(
        np.concatenate([small.vertices, large.vertices]), np.concatenate([grid(3, 5), grid(3, 3) + small.vertex_count])
    )
    piece = largest_piece(both, np.ones(both.face_count, dtype=bool))
    np.testing.assert_array_equal(piece, np.arange(both.face_count) >= small.face_count)
    without = largest_piece(both, np.arange(both.face_count) < small.face_count)
    np.testing.assert_array_equal(without, np.arange(both.face_count) < small.face_count)
    assert not largest_piece(both, np.zeros(both.face_count, dtype=bool)).any()


def test_openings_look_out_of_the_mesh():
    for mesh, up in ((tube(), TURN @ [0, 1, 0]), (tube(17, 3), TURN @ [0, 1, 0])):
        mesh = mesh.with_vertices(mesh.vertices @ TURN.T)
        top, bottom = sorted(border_loops(mesh.faces), key=lambda loop: -(mesh.vertices[loop] @ up).mean())
        np.testing.assert_allclose(opening_axis(mesh, top), up, atol=1e-6)
        np.testing.assert_allclose(opening_axis(mesh, bottom), -up, atol=1e-6)
    flat = TriangleMesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    assert not opening_axis(flat, np.array([0, 1, 2])).any()


def test_cloth_that_is_inside_out_is_told_from_cloth_that_is_not():
    body = ball(0.12)
    assert not looks_inwards(tube(), body) and looks_inwards(turned_over(tube()), body)
    tight = body.with_vertices(0.99 * body.vertices)  # a little inside the skin
    assert not looks_inwards(tight, body) and looks_inwards(turned_over(tight), body)
