"""Patches of holes: closed, manifold, turned as the mesh around, of the least area, and moving with it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smplxpp.assemble.patch import MAX_LOOP, patch_loop
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.topology import border_loops, edge_groups
from smplxpp.metrics import mesh_quality


def ring(count: int, wave: np.ndarray | float = 0.0, inner: float = 0.05) -> TriangleMesh:
    """A flat collar about a hole, facing +z; the hole's border is lifted by `wave`, metres."""
    angle = 2.0 * np.pi * np.arange(count) / count
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    hole = inner * circle
    hole[:, 2] += wave
    a, b = np.arange(count), np.roll(np.arange(count), -1)
    faces = np.concatenate([np.stack([a, a + count, b + count], 1), np.stack([a, b + count, b], 1)])
    return TriangleMesh(np.concatenate([hole, 2 * inner * circle]), faces)


def closed(mesh: TriangleMesh) -> TriangleMesh:
    """With its first hole patched."""
    loop = border_loops(mesh.faces)[0]
    patch = patch_loop(mesh, loop)
    at = np.concatenate([loop, mesh.vertex_count + np.arange(len(patch.from_rim))])
    new = patch.from_rim @ mesh.vertices[loop]
    return TriangleMesh(np.concatenate([mesh.vertices, new]), np.concatenate([mesh.faces, at[patch.faces]]))


def test_a_round_hole_is_filled_flat_with_faces_as_small_as_those_around():
    mesh = ring(24)
    loop = border_loops(mesh.faces)[0]
    patch = patch_loop(mesh, loop)
    rim = mesh.vertices[loop]
    assert patch.area(rim) == pytest.approx(0.5 * 24 * 0.05**2 * np.sin(2 * np.pi / 24), rel=1e-9)
    whole = closed(mesh)
    assert (whole.face_normals @ [0.0, 0.0, 1.0] > 0.999).all() and len(border_loops(whole.faces)) == 1
    edge = np.linalg.norm(rim[1] - rim[0])
    areas = whole.face_areas[mesh.face_count :]
    assert len(patch.from_rim) > 10 and areas.max() < 3.0 * (3**0.5 / 4) * edge**2
    np.testing.assert_allclose(patch.from_rim.sum(axis=1), 1.0, atol=1e-12)
    assert patch.from_rim.min() >= 0.0


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(4, 60),
    waves=st.lists(st.tuples(st.floats(0, 0.03), st.integers(1, 4)), max_size=2),
    seed=st.integers(0, 9),
)
@pytest.mark.long
def test_any_wavy_hole_is_closed_manifold_and_within_its_rim(count, waves, seed):
    angle = 2.0 * np.pi * np.arange(count) / count
    wave = sum((size * np.cos(times * angle + seed) for size, times in waves), np.zeros(count))
    mesh = ring(count, wave + 1e-4 * np.random.default_rng(seed).normal(size=count))
    whole = closed(mesh)
    quality = mesh_quality(whole)
    assert quality.nonmanifold_edges == quality.nonmanifold_vertices == quality.inconsistent_edges == 0
    assert quality.border_loops == 1 and quality.duplicate_faces == 0 and quality.components == 1
    new = whole.vertices[mesh.vertex_count :]
    low, high = mesh.vertices[:count].min(0) - 1e-12, mesh.vertices[:count].max(0) + 1e-12
    assert ((new >= low) & (new <= high)).all()


def test_it_moves_with_the_mesh_and_knows_no_units():
    angle = 2.0 * np.pi * np.arange(30) / 30
    mesh = ring(30, 0.02 * np.cos(2 * angle) + 0.003 * np.random.default_rng(1).normal(size=30))
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    moved = mesh.with_vertices(1000.0 * mesh.vertices @ turn.T + [30.0, -7.0, 5.0])
    one, other = closed(mesh), closed(moved)
    np.testing.assert_array_equal(one.faces, other.faces)
    np.testing.assert_allclose(other.vertices, 1000.0 * one.vertices @ turn.T + [30.0, -7.0, 5.0], atol=1e-8)


def test_an_edge_that_exists_outside_gets_no_twin():
    """Beside a rim with edges across it no edge gets a third face."""
    mesh = ring(8)
    rim = border_loops(mesh.faces)[0]
    eared = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, [[1, 2, 0]]]))  # a corner is filled
    tip = mesh.vertices[4:5] + [0.0, 0.0, 0.2]
    over = TriangleMesh(np.concatenate([mesh.vertices, tip]), np.concatenate([mesh.faces, [[3, 5, 16]]]))
    for one, loop in ((eared, rim[rim != 1]), (over, rim)):
        patch = patch_loop(one, loop)
        at = np.concatenate([loop, one.vertex_count + np.arange(len(patch.from_rim))])
        _, _, count = edge_groups(np.concatenate([one.faces, at[patch.faces]]))
        assert count.max() == 2


def test_a_border_of_tiny_edges_gets_no_myriad_of_faces():
    angle = 2.0 * np.pi * np.sort(np.r_[np.linspace(0, 0.99, 12), 0.5 + 1e-4 * np.arange(1, 40)])
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    a, b = np.arange(len(angle)), np.roll(np.arange(len(angle)), -1)
    faces = np.concatenate([np.stack([a, a + len(a), b + len(a)], 1), np.stack([a, b + len(a), b], 1)])
    mesh = TriangleMesh(np.concatenate([0.05 * circle, 0.1 * circle]), faces)
    whole = closed(mesh)
    assert whole.face_count < mesh.face_count + 4000 and len(border_loops(whole.faces)) == 1


def test_borders_that_are_none_are_refused():
    with pytest.raises(InputError, match="3 to"):
        patch_loop(ring(8), np.arange(2))
    with pytest.raises(InputError, match=str(MAX_LOOP)):
        patch_loop(ring(MAX_LOOP + 1), np.arange(MAX_LOOP + 1))
    mesh = ring(4)
    crossed = TriangleMesh(
        np.concatenate([mesh.vertices, [[0.0, 0.0, 0.1], [0.0, 0.0, -0.1]]]),
        np.concatenate([mesh.faces, [[0, 2, 8], [1, 3, 9]]]),
    )
    with pytest.raises(InputError, match="across"):
        patch_loop(crossed, np.arange(4))
