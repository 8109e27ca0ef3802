"""Cloth dynamics of the synthetic capture: constraints, stability, contact; hair that lags."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.synth.cloth_model import ClothModel, Fabric, build_cloth, color_edges
from pipelines.synth.cloth_solver import ClothSolver, SolverConfig, Tick
from pipelines.synth.contact import body_contacts, depths, sheet_contacts
from pipelines.synth.simulate import HairLag
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.rotations import matrix_from_rotvec

SECONDS = 1 / 50


def sheet(width: int = 9, height: int = 13, cell: float = 0.03) -> TriangleMesh:
    """A rectangle in the xy plane, its upper edge at y = 0, facing +z."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    vertices = cell * np.stack([x.ravel() - (width - 1) / 2, -y.ravel(), 0 * x.ravel()], axis=1)
    a = (np.arange(height - 1)[:, None] * width + np.arange(width - 1)).ravel()
    b, c, d = a + 1, a + width, a + width + 1
    return TriangleMesh(vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]))


def ball(radius: float) -> TriangleMesh:
    """A closed sphere of latitudes and longitudes."""
    n, m = 24, 48
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n + 1)[1:-1], 2 * np.pi * np.arange(m) / m, indexing="ij")
    rings = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1).reshape(-1, 3)
    vertices = radius * np.concatenate([rings, [[0, 1, 0], [0, -1, 0]]])
    a = (np.arange(n - 2)[:, None] * m + np.arange(m)).ravel()
    b = (np.arange(n - 2)[:, None] * m + (np.arange(m) + 1) % m).ravel()
    top = np.stack([np.full(m, len(rings)), (np.arange(m) + 1) % m, np.arange(m)], axis=1)
    last = (n - 2) * m
    bottom = np.stack([np.full(m, len(rings) + 1), last + np.arange(m), last + (np.arange(m) + 1) % m], axis=1)
    faces = np.concatenate([np.stack([a, b, a + m], 1), np.stack([b, b + m, a + m], 1), top, bottom])
    return TriangleMesh(vertices, faces)


def hung(mesh: TriangleMesh, **fabric) -> ClothModel:
    """The sheet with its upper edge held."""
    return build_cloth(mesh, (mesh.vertices[:, 1] > -1e-9).astype(float), Fabric(**fabric))


def edge_lengths(mesh: TriangleMesh, vertices: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vertices[mesh.edges[:, 0]] - vertices[mesh.edges[:, 1]], axis=1)


def still(mesh: TriangleMesh, contacts=()) -> Tick:
    return Tick(SECONDS, (mesh.vertices, mesh.vertices), list(contacts))


def test_colours_share_no_vertex_and_hold_every_edge_once():
    mesh = ball(0.2)
    groups = color_edges(mesh.edges, mesh.vertex_count)
    assert sorted(np.concatenate(groups)) == list(range(len(mesh.edges)))
    assert all(np.bincount(mesh.edges[group].ravel()).max() == 1 for group in groups)
    assert len(groups) <= 2 * np.bincount(mesh.edges.ravel()).max() - 1


def test_a_rigid_turn_of_the_cloth_meets_no_resistance():
    mesh = sheet()
    curved = mesh.with_vertices(mesh.vertices + [0, 0, 0.02] * np.sin(20 * mesh.vertices[:, :1]))
    solver = ClothSolver(build_cloth(curved, np.zeros(mesh.vertex_count), Fabric()), curved.vertices)
    turned = curved.vertices @ matrix_from_rotvec(np.array([0.3, 1.1, -0.4])).T + [0.1, 2.0, 0.3]
    moved = turned.copy()
    solver._stretch(moved, 1e-3)
    solver._bend(moved, solver._hinge_normals(moved), 1e-3)
    np.testing.assert_allclose(moved, turned, atol=1e-9)


def test_bending_returns_to_the_curvature_at_rest():
    mesh = sheet()
    curved = mesh.with_vertices(mesh.vertices + [0, 0, 0.01] * np.sin(20 * mesh.vertices[:, :1]))
    solver = ClothSolver(build_cloth(curved, np.zeros(mesh.vertex_count), Fabric()), curved.vertices)
    hinges = solver.model.hinges

    def error(x: np.ndarray) -> float:
        return float(np.linalg.norm(np.einsum("hi,hi->h", hinges.operator @ x, solver._hinge_normals(x)) - hinges.rest))

    assert error(curved.vertices) < 1e-12
    x = mesh.vertices.copy()
    errors = [error(x)]
    for _ in range(60):
        solver._bend(x, solver._hinge_normals(x), 1.0)
        errors.append(error(x))
    assert (np.diff(errors) < 1e-12).all()
    assert errors[-1] < 0.5 * errors[0]


def test_a_hanging_sheet_hangs_straight_and_hardly_stretches():
    mesh = sheet()
    # It starts level and swings down.
    level = mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]
    solver = ClothSolver(hung(mesh), level, SolverConfig(substeps=8, drag=6.0))
    seen = 0.0
    for _ in range(90):
        solver.advance(Tick(SECONDS, (level, level), []))
        strain = edge_lengths(mesh, solver.position) / edge_lengths(mesh, mesh.vertices) - 1
        seen = max(seen, np.percentile(np.abs(strain), 99))
    assert seen < 0.1
    assert solver.position[:, 1].min() == pytest.approx(mesh.vertices[:, 1].min(), abs=0.02)
    assert np.abs(solver.position[:, 2]).max() < 0.06
    np.testing.assert_array_equal(solver.position[:9], level[:9])


def test_held_particles_follow_their_places_and_the_rest_lags():
    mesh = sheet()
    solver = ClothSolver(hung(mesh), mesh.vertices)
    for _ in range(10):
        solver.advance(still(mesh))
    before = mesh.vertices
    for _ in range(5):
        after = before + [0, 0, 0.03]
        solver.advance(Tick(SECONDS, (before, after), []))
        before = after
    np.testing.assert_allclose(solver.position[:9], before[:9], atol=1e-12)
    hem = mesh.vertices[:, 1] < -0.34
    assert (solver.position[hem, 2] < before[hem, 2] - 0.02).all()


def test_a_falling_sheet_stays_outside_a_ball():
    mesh, core = sheet(13, 13, 0.025), ball(0.12)
    flat = mesh.vertices[:, [0, 2, 1]] * [1, 1, -1] + [0, 0.14, -0.15]
    cloth = mesh.with_vertices(flat)
    solver = ClothSolver(build_cloth(cloth, np.zeros(mesh.vertex_count), Fabric()), flat)
    particles = np.arange(mesh.vertex_count)
    for _ in range(20):
        contacts = body_contacts(core, cloth.with_vertices(solver.position), particles, margin=0.004)
        solver.advance(still(cloth, [(contacts, (core.vertices, core.vertices))]))
    assert solver.position[:, 1].min() < 0.08  # it drapes
    assert depths(core, solver.position).max() < 5e-4


def test_contacts_follow_a_moving_surface_and_hold_by_friction():
    core = ball(0.1)
    patch = sheet(3, 3, 0.002)
    points = patch.vertices[:, [0, 2, 1]] * [1, 1, -1] + [0, 0.1005, -0.002]
    contacts = body_contacts(core, patch.with_vertices(points), np.arange(9), margin=0.002)
    assert len(contacts.particle) == 9
    moved, x = core.vertices + [0.01, 0, 0], points.copy()
    contacts.resolve(x, points, (core.vertices, moved), friction=50.0)
    np.testing.assert_allclose((x - points)[:, 0], 0.01, atol=1e-3)
    assert (np.linalg.norm(x - [0.01, 0, 0], axis=1) > 0.1).all()


def test_a_sheet_pushes_to_its_outer_side_only_within_its_border():
    lower = sheet()
    upper = lower.with_vertices(0.9 * lower.vertices + [0.0, -0.02, -0.003])
    aside = lower.with_vertices(lower.vertices + [1.0, 0, 0])
    every = np.arange(lower.vertex_count)
    contacts = sheet_contacts(lower, upper, every, margin=0.003)
    assert len(contacts.particle) > 0.7 * lower.vertex_count
    np.testing.assert_allclose(contacts.normal, np.tile([0.0, 0, 1], (len(contacts.normal), 1)), atol=1e-6)
    assert not len(sheet_contacts(lower, aside, every, margin=0.003).particle)


def test_hair_trails_a_turning_head_and_comes_to_rest():
    lag, pivot = HairLag(np.eye(3)), np.array([0.0, 1.5, 0.0])
    tip, crown = np.array([[0.1, 1.4, 0.0]]), np.array([[0.1, 1.6, 0.0]])
    lag.advance(np.eye(3), 0.02)
    np.testing.assert_array_equal(lag.applied(tip, np.ones(1), pivot), tip)
    turned = matrix_from_rotvec(np.array([0.0, 0.2, 0.0]))
    lag.advance(turned, 0.02)
    late = lag.applied(tip, np.ones(1), pivot)
    assert late[0, 2] > tip[0, 2] + 1e-3  # +y turns +x towards -z: the tip stays behind
    np.testing.assert_array_equal(lag.applied(crown, np.zeros(1), pivot), crown)
    for _ in range(200):
        lag.advance(turned, 0.02)
    np.testing.assert_allclose(lag.applied(tip, np.ones(1), pivot), tip, atol=1e-5)
