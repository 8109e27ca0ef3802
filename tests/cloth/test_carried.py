"""Kernels of what cloth carries, against numpy: the embedding, skin that comes through, skinning there and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.cloth.embedding import CarriedVertices, SkinnedRows, embed
from smplxpp.cloth.solver import Collider, move_before_collider
from smplxpp.core import InputError, TriangleMesh
from tests.cloth.persons import person, standing
from tests.cloth.sheets import ball, bent, collider, hanging

NOTHING = Collider(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), np.zeros(0, np.float32))
NOWHERE = np.zeros((0, 3), np.float32)


def scattered(coarse: TriangleMesh, count: int = 400) -> np.ndarray:
    """(count, 3) places about a mesh."""
    rng = np.random.default_rng(3)
    corners = coarse.vertices[coarse.faces[rng.integers(coarse.face_count, size=count)]]
    weights = rng.dirichlet(np.ones(3), size=count)
    return np.einsum("nk,nki->ni", weights, corners) + rng.normal(scale=0.01, size=(count, 3))


def shaken(coarse: TriangleMesh) -> TriangleMesh:
    rng = np.random.default_rng(4)
    return coarse.with_vertices(
        (coarse.vertices + rng.normal(scale=0.01, size=coarse.vertices.shape)).astype("float32")
    )


def test_vertices_are_carried_as_numpy_carries_them():
    coarse = bent(hanging())
    embedding = embed(scattered(coarse), coarse)
    moved = shaken(coarse)
    carried = CarriedVertices(embedding, coarse.faces, NOTHING, coarse.vertex_count)
    found = carried.at(moved.vertices.astype(np.float32), NOWHERE, margin=0.002)
    np.testing.assert_allclose(found, embedding.carried(moved), atol=2e-6)
    assert np.abs(found - scattered(coarse)).max() > 0.01


def test_what_is_carried_is_pushed_out_as_points_are_and_deep_vertices_by_less():
    """All at once, and none beside them, they would be spikes."""
    coarse = bent(hanging())
    body = ball(radius=0.1)
    body = body.with_vertices(body.vertices + coarse.vertices.mean(axis=0) - [0.0, 0.0, 0.085])
    embedding, solid = embed(scattered(coarse), coarse), collider(body)
    carried = CarriedVertices(embedding, coarse.faces, solid, coarse.vertex_count)
    skin = body.vertices.astype(np.float32)
    found = carried.at(coarse.vertices.astype(np.float32), skin, margin=0.002)
    points, normals = embedding.carried_with_normals(coarse)
    expected = move_before_collider(points.astype(np.float32), normals, skin, solid, margin=0.002)
    depth = np.linalg.norm(expected - points, axis=1) - 0.002
    share = np.clip(2.0 - depth / 0.015, 0.0, 1.0)[:, None]
    assert ((share > 0.1) & (share < 0.9)).sum() > 10 and (depth > 0.03).any()
    np.testing.assert_allclose(found, points + share * (expected - points), atol=2e-5)
    pushed = np.linalg.norm(found - points, axis=1) > 1e-4
    assert 0.02 < pushed.mean() < 0.98


def test_skin_does_not_come_through_the_middle_of_a_long_edge():
    """A knee stood before a pleat whose vertices were all before the knee."""
    sheet = hanging(5, 5, 0.06)
    ends = sheet.edges[np.flatnonzero(np.ptp(sheet.vertices[sheet.edges], axis=1)[:, 1] == 0.0)[5]]
    knee = ball(radius=0.03)
    middle = sheet.vertices[ends].mean(axis=0) + np.array([0.0, 0.0, -0.02])
    knee = knee.with_vertices(knee.vertices + middle)
    lengths = np.linalg.norm(np.diff(sheet.vertices[sheet.edges], axis=1)[:, 0], axis=1)

    def clearance(bounds):
        embedding = embed(sheet.vertices, sheet)
        carried = CarriedVertices(embedding, sheet.faces, collider(knee), sheet.vertex_count, bounds)
        found = carried.at(sheet.vertices.astype(np.float32), knee.vertices.astype(np.float32), margin=0.002)
        along = found[ends[0]] + np.linspace(0.0, 1.0, 31)[:, None] * (found[ends[1]] - found[ends[0]])
        return np.linalg.norm(along - middle, axis=1).min() - 0.03

    assert clearance(None) < -0.009
    assert clearance((sheet.edges, 9.0 * lengths)) > 0.0


def test_drawn_edges_keep_their_bound_where_what_carries_them_turns():
    """Vertices 24 mm off the simulated cloth were drawn apart to nine times their length in the fold of a skirt."""
    coarse = hanging(5, 7, 0.03)
    # A second layer 30 mm before the sheet, which folds away from it at a right angle in the middle.
    fine = hanging(21, 31, 0.006)
    fine = fine.with_vertices(fine.vertices + [0, 0, 0.03])
    y = coarse.vertices[:, 1] - coarse.vertices[:, 1].mean()
    folded = coarse.with_vertices(
        np.where((y < 0)[:, None], np.stack([coarse.vertices[:, 0], 0 * y, y], axis=1), coarse.vertices * [1, 0, 0])
        + np.where((y > 0)[:, None], np.stack([0 * y, y, 0 * y], axis=1), 0.0)
    )
    embedding, edges = embed(fine.vertices, coarse), fine.edges
    rest = np.linalg.norm(fine.vertices[edges[:, 0]] - fine.vertices[edges[:, 1]], axis=1)

    def longest(bounds):
        carried = CarriedVertices(embedding, coarse.faces, NOTHING, coarse.vertex_count, bounds)
        found = carried.at(folded.vertices.astype(np.float32), NOWHERE, margin=0.0)
        return (np.linalg.norm(found[edges[:, 0]] - found[edges[:, 1]], axis=1) / rest).max(), found

    free, loose = longest(None)
    bound, found = longest((edges, 1.5 * rest))
    assert free > 2.0 and bound < 1.55
    # Nothing else is moved: what lies far from the fold stays.
    far = np.abs(fine.vertices[:, 1] - fine.vertices[:, 1].mean()) > 0.07
    assert far.any() and (found[far] == loose[far]).all()


def test_skinning_there_and_back_is_that_of_the_template():
    template, params = person(), standing(at=(0.3, 0.1, -0.2), turned=0.7, lifted=0.4)
    body, origin = template.posed_body(params), np.array([0.1, 0.2, 0.3])
    rows = np.arange(5, template.vertex_count, 7)
    skinned = SkinnedRows(template.weights, rows)
    rest = template.vertices.astype(np.float32)
    blended = np.einsum("vj,jab->vab", template.weights.dense(), body.posed_from_rest[0])
    expected = np.einsum("vij,vj->vi", blended[:, :3, :3], template.vertices) + blended[:, :3, 3] - origin
    places = skinned.posed(body, rest, origin=origin)
    np.testing.assert_allclose(places, expected[rows], atol=2e-6)
    by = np.random.default_rng(0).normal(scale=0.05, size=(len(rows), 3))
    there = places + np.einsum("vij,vj->vi", blended[rows][:, :3, :3], by).astype(np.float32)
    np.testing.assert_allclose(skinned.unposed(body, rest, there, origin=origin, least_determinant=0.2), by, atol=1e-5)


def test_blends_that_are_flat_leave_vertices_to_skinning():
    template = person()
    body = template.posed_body(standing())
    flat = body.posed_from_rest.copy()
    flat[:, :, 0, :3] *= 0.1
    rows = np.arange(20)
    skinned = SkinnedRows(template.weights, rows)
    rest = template.vertices.astype(np.float32)
    places = np.ones((20, 3), np.float32)
    found = skinned.unposed(
        replace(body, posed_from_rest=flat), rest, places, origin=np.zeros(3), least_determinant=0.2
    )
    assert not found.any()


def test_indices_beyond_their_arrays_are_refused():
    template = person()
    body = template.posed_body(standing())
    skinned = SkinnedRows(template.weights, np.array([0, template.vertex_count]))
    with pytest.raises(InputError, match="indices"):
        skinned.posed(body, template.vertices.astype(np.float32), origin=np.zeros(3))
    coarse = bent(hanging())
    embedding = embed(scattered(coarse), coarse)
    carried = CarriedVertices(embedding, coarse.faces + 1, NOTHING, coarse.vertex_count)
    with pytest.raises(InputError, match="indices"):
        carried.at(coarse.vertices.astype(np.float32), NOWHERE, margin=0.002)
