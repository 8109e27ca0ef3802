"""Pushing layers apart: nothing left inside, no spike, no face turned, and nothing moved without need."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from smplxpp.assemble import Obstacle, PushConfig, flipped_faces, measure_penetration, push_out, stand_off
from smplxpp.assemble.layers import face_points
from smplxpp.core import InputError, TriangleMesh

module = sys.modules[push_out.__module__]  # the package has a function of its name


def ball(radius: float, subdivisions: int = 4) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def dented(radius: float = 0.105, depth: float = 0.012) -> TriangleMesh:
    """A ball around the one of 0.1 m, with a dent that goes into it."""
    mesh = ball(radius)
    dent = np.exp(-((1 - mesh.vertices[:, 0] / radius) ** 2) / 0.02)
    return mesh.with_vertices(mesh.vertices * (1 - depth / radius * dent)[:, None])


def solid(mesh: TriangleMesh) -> Obstacle:
    return Obstacle("body", mesh, solid=True, max_depth=0.03)


def test_a_dent_is_pushed_out_to_the_clearance():
    inner, outer = ball(0.1), dented()
    before = measure_penetration(outer, solid(inner))
    assert before.vertices > 20
    assert before.depth_max == pytest.approx(0.007, abs=5e-4)
    moved = outer.with_vertices(push_out(outer, [solid(inner)], PushConfig(clearance=1e-3)))
    after = measure_penetration(moved, solid(inner))
    assert (after.vertices, after.face_points) == (0, 0)
    assert np.linalg.norm(moved.vertices, axis=1).min() > 0.1
    assert not flipped_faces(outer, moved.vertices).any()
    way = np.linalg.norm(moved.vertices - outer.vertices, axis=1)
    assert way.max() < 0.0095
    # No spike: neighbours' ways differ by less than half the longest.
    assert np.abs(np.diff(way[moved.edges], axis=1)).max() < 0.5 * way.max()
    # Away from the dent nothing moves.
    assert way[outer.vertices[:, 0] < 0].max() < 1e-6


def test_a_body_asks_for_no_normals_of_the_displaced_layer(monkeypatch):
    """They were computed in each of hundreds of projections, though only garments ask which way a point faces."""
    outer, asked, compute = dented(depth=0.014), [], TriangleMesh.vertex_normals.func
    counted = property(lambda mesh: (asked.append(mesh), compute(mesh))[1])
    monkeypatch.setattr(TriangleMesh, "vertex_normals", counted)
    push_out(outer, [solid(ball(0.1, subdivisions=3))], PushConfig(clearance=2e-3))
    assert {id(mesh) for mesh in asked if mesh.face_count == outer.face_count} == {id(outer)}


@pytest.mark.parametrize("is_solid", [True, False])
def test_points_that_stay_are_not_asked_again_and_no_bit_changes(is_solid, monkeypatch):
    """Hundreds of projections asked of the same distances again and again."""
    asked = []

    class Counted(Obstacle):
        def distance(self, points, normals):
            asked.append(len(points))
            return super().distance(points, normals)

    def pushed() -> tuple[np.ndarray, int]:
        asked.clear()
        obstacle = Counted("inner", ball(0.1), solid=is_solid, max_depth=0.03)
        return push_out(dented(depth=0.014), [obstacle], PushConfig(clearance=2e-3)), sum(asked)

    few, fewer = pushed()
    monkeypatch.setattr(module._Distances, "after", lambda self, _, *moved: self._obstacle.distance(*moved))
    always, all_of_them = pushed()
    assert np.array_equal(few, always)
    assert fewer < all_of_them if is_solid else fewer <= all_of_them  # a garment asks where a point faces, too


def test_clear_layers_are_left_alone():
    outer = ball(0.11)
    assert np.array_equal(push_out(outer, [solid(ball(0.1))]), outer.vertices)
    assert np.array_equal(push_out(outer, []), outer.vertices)


def test_rigid_motion_moves_the_answer_along():
    # Turned against each other: where two faces are equally near, rounding would choose.
    skew = Rotation.from_rotvec([0.11, 0.23, 0.35]).as_matrix()
    inner, outer = ball(0.1, 3), dented()
    inner = inner.with_vertices(inner.vertices @ skew.T)
    turn, shift = Rotation.from_euler("xyz", [1.0, 0.2, -0.7]).as_matrix(), np.array([0.3, 1.0, -0.2])
    moved_inner = inner.with_vertices(inner.vertices @ turn.T + shift)
    moved_outer = outer.with_vertices(outer.vertices @ turn.T + shift)
    here, there = push_out(outer, [solid(inner)]), push_out(moved_outer, [solid(moved_inner)])
    assert np.allclose(there, here @ turn.T + shift, atol=1e-6)


def test_order_of_the_vertices_does_not_matter():
    inner, outer = ball(0.1, 3), dented()
    order = np.random.default_rng(0).permutation(outer.vertex_count)
    back = np.argsort(order)
    shuffled = TriangleMesh(outer.vertices[order], back[outer.faces])
    assert np.allclose(push_out(shuffled, [solid(inner)])[back], push_out(outer, [solid(inner)]), atol=1e-9)


def half(mesh: TriangleMesh) -> TriangleMesh:
    return mesh.submesh(mesh.triangles.mean(axis=1)[:, 0] > 0)[0]


def test_garments_are_open_surfaces():
    # A half shell: what lies far behind it, or beside its border, is not "inside".
    inner = Obstacle("shirt", half(ball(0.1)), solid=False, max_depth=0.03)
    assert measure_penetration(half(ball(0.098)), inner).vertices > 100
    assert measure_penetration(half(ball(0.06)), inner).vertices == 0
    assert measure_penetration(ball(0.05, 2).with_vertices(ball(0.05, 2).vertices - [0.3, 0, 0]), inner).vertices == 0
    outer = half(dented())
    moved = outer.with_vertices(push_out(outer, [inner]))
    assert measure_penetration(outer, inner).vertices > 20
    assert measure_penetration(moved, inner).vertices == 0


def test_no_move_shorter_than_the_bound_leads_behind_a_garment():
    """A vertex beside a ragged hem was pushed behind it and not asked again, because its bound was a distance without
    a sign that means anything: a tenth of a millimetre stayed inside, and the build failed."""
    rng, shell = np.random.default_rng(0), half(ball(0.1, 5))
    shell = shell.with_vertices(shell.vertices * (1.0 + 0.02 * rng.normal(size=(shell.vertex_count, 1))))
    kept = (rng.uniform(size=shell.face_count) > 0.5) | (shell.triangles.mean(axis=1)[:, 0] > 0.03)
    inner = Obstacle("trousers", shell.submesh(kept)[0], solid=False, max_depth=0.015)
    # About the hem, and behind the shell farther than a vertex can be within it.
    x, radius, turn = rng.uniform([-0.004, 0.095, -np.pi], [0.03, 0.105, np.pi], (20_000, 3)).T
    behind = [[x, radius * np.cos(turn), radius * np.sin(turn)], [0.078 * np.cos(turn), 0.078 * np.sin(turn), 0.0 * x]]
    for start in (np.stack(rows, axis=1) for rows in behind):
        move = rng.normal(size=start.shape)
        move *= rng.uniform(0.0, 0.008, len(move))[:, None] / np.linalg.norm(move, axis=1, keepdims=True)
        outwards = (start + move) / np.linalg.norm(start + move, axis=1, keepdims=True)
        unknown = np.isinf(inner.distance(start, outwards)[0])
        inside = unknown & (inner.distance(start + move, outwards)[0] < 0)
        assert inside.sum() > 30
        assert (inner.lower_bound(start[inside]) < np.linalg.norm(move[inside], axis=1)).all()


@pytest.mark.parametrize(
    "change",
    [{"clearance": 0.0}, {"damping": 1.5}, {"iterations": -1}, {"max_depth": 0.0}, {"reach": (0.03, 0.01)}],
)
def test_bad_configuration(change):
    with pytest.raises(InputError, match="push configuration"):
        PushConfig(**change)


def test_a_shared_seam_stays_closed():
    # One sheet cut in two: the pieces touch along the cut, and neither has come through the other.
    whole = ball(0.1)
    lower = whole.triangles.mean(axis=1)[:, 1] < 0
    inner, outer = whole.submesh(lower)[0], whole.submesh(~lower)[0]
    obstacle = Obstacle("trousers", inner, solid=False, max_depth=0.03)
    assert measure_penetration(outer, obstacle).vertices == 0
    assert np.abs(push_out(outer, [obstacle]) - outer.vertices).max() < 1e-9


@pytest.mark.long
def test_nothing_is_pushed_beyond_the_limit_and_the_surface_stays_smooth():
    inner, outer = ball(0.1), dented(depth=0.035)
    far = push_out(outer, [solid(inner)]) - outer.vertices
    assert np.linalg.norm(far, axis=1).max() > 0.028
    moved = outer.with_vertices(push_out(outer, [solid(inner)], limit=0.012))
    way = np.linalg.norm(moved.vertices - outer.vertices, axis=1)
    assert way.max() == pytest.approx(0.012, rel=1e-9)
    left = measure_penetration(moved, solid(inner))
    # What needs 31 mm is 19 mm short, but for the clearance; what needs less than the limit is out.
    assert left.depth_max == pytest.approx(0.030 - 0.012, abs=5e-4)
    start = np.linalg.norm(outer.vertices, axis=1)
    assert np.linalg.norm(moved.vertices, axis=1)[start > 0.1 - 0.010].min() > 0.1
    # No cliff where the limit begins to hold, and nothing turns over.
    steps = [np.abs(np.diff(lengths[moved.edges], axis=1)).max() for lengths in (way, np.linalg.norm(far, axis=1))]
    assert steps[0] <= steps[1]
    assert not flipped_faces(outer, moved.vertices).any()


def test_a_limit_that_nothing_reaches_changes_no_bit():
    inner, outer = ball(0.1), dented()
    assert np.array_equal(push_out(outer, [solid(inner)], limit=0.01), push_out(outer, [solid(inner)]))


@pytest.mark.parametrize(("gap", "expected"), [(0.002, 0.010), (0.02, 0.02), (0.05, 0.030), (-0.02, 0.010)])
def test_the_stand_off_is_the_parts_own_within_its_reach(gap, expected):
    # Chords run below the arcs: a ball of triangles is flatter by a fifth of a millimetre.
    assert stand_off(ball(0.1 + gap), solid(ball(0.1))) == pytest.approx(expected, abs=3e-4)


def test_points_on_faces_lie_as_densely_as_asked_and_a_small_face_has_its_centre():
    mesh = TriangleMesh(
        np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.04, 0, 0], [0, 0, 0.05]]), np.array([[0, 1, 2], [0, 3, 4]])
    )
    points = face_points(mesh, spacing=0.016)
    assert np.bincount(points.face).tolist() == [1, 25]  # the longest edges: 14 and 64 mm
    np.testing.assert_allclose(points.weights.sum(axis=1), 1.0)
    at = points.of(mesh, mesh.vertices)
    np.testing.assert_allclose(at[points.face == 0], mesh.face_centers[:1])
    # Everywhere on the long face a point is near.
    own = np.random.default_rng(0).dirichlet([1, 1, 1], 500) @ mesh.vertices[mesh.faces[1]]
    assert np.linalg.norm(own[:, None] - at[None, points.face == 1], axis=2).min(axis=1).max() < 0.011


def tube(radius: float, sections: int, rings: int, height: float) -> TriangleMesh:
    """An open tube about the z axis, whose faces look outward."""
    angle = 2 * np.pi * np.arange(sections) / sections
    ring = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    z = height * (np.arange(rings) - 0.5 * (rings - 1))[:, None, None] * [0.0, 0.0, 1.0]
    k, j = np.indices((rings - 1, sections)).reshape(2, -1)
    a, b = k * sections + j, k * sections + (j + 1) % sections
    c, d = a + sections, b + sections
    return TriangleMesh((ring + z).reshape(-1, 3), np.concatenate([np.c_[a, b, d], np.c_[a, d, c]]))


def test_long_faces_do_not_cut_the_limb_between_their_corners():
    """Skin showed as specks through smooth trousers, whose faces were four times as long as the mean."""
    limb = trimesh.creation.capsule(0.4, 0.05, count=[90, 90])
    inner = solid(TriangleMesh(np.asarray(limb.vertices), np.asarray(limb.faces)))
    outer = tube(0.0612, 5, 8, 0.04)  # centres of faces are 1 mm outside, middles of edges 0.5 mm inside

    def depth(mesh: TriangleMesh) -> float:
        return 0.05 - np.hypot(*mesh.vertices[mesh.edges].mean(axis=1)[:, :2].T).min()

    assert depth(outer) > 4e-4
    moved = outer.with_vertices(push_out(outer, [inner], PushConfig(clearance=1e-3)))
    assert depth(moved) < 0.0
    assert measure_penetration(moved, inner).face_points == 0 < measure_penetration(outer, inner).face_points
