"""Clothes of the synthetic capture: what they touch, that they rest, swing and repeat; hair that lags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from smplxpp.core import TriangleMesh, matrix_from_rotvec
from smplxpp.people.fixture_person import load_person
from smplxpp.synth.checks import depths, free_edge_strain
from smplxpp.synth.garment_dynamics import ContactSurface, GarmentConfig, GarmentDynamics
from smplxpp.synth.motion import Performance
from smplxpp.synth.simulate import HairLag, SimulationConfig, simulate
from tests.cloth.sheets import ball, hanging, held, lying

TOPOLOGY = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person" / "geometry" / "topology.npz"
SECONDS = 1 / 50


FAR = lying(3, 3, 0.01, -9.0)


def free(mesh: TriangleMesh) -> np.ndarray:
    return np.zeros(mesh.vertex_count)


class Alone(GarmentDynamics):
    """A garment that touches nothing."""

    def __init__(self, mesh: TriangleMesh, hold: np.ndarray) -> None:
        super().__init__(mesh, hold, [ContactSurface(FAR.faces, 0.004, 0.05)], GarmentConfig())

    def go(self, before: np.ndarray, after: np.ndarray) -> None:
        self.advance(SECONDS, (before, after), [(FAR.vertices, FAR.vertices)])


def test_held_vertices_follow_their_places_and_the_rest_lags():
    mesh = hanging(9, 13)
    garment = Alone(mesh, held(mesh))
    for _ in range(10):
        garment.go(mesh.vertices, mesh.vertices)
    before = mesh.vertices
    for _ in range(5):
        after = before + [0, 0, 0.03]
        garment.go(before, after)
        before = after
    np.testing.assert_allclose(garment.position[:9], before[:9], atol=1e-6)
    hem = mesh.vertices[:, 1] < -0.34
    assert (garment.position[hem, 2] < before[hem, 2] - 0.02).all()


def test_fine_cloth_hangs_still_at_the_length_that_it_was_cut_to():
    mesh = hanging(40, 40, 0.008)  # a sweep of its stiff edges from the top downwards would make it tremble
    garment = Alone(mesh, held(mesh))
    for _ in range(20):
        before = garment.position
        garment.go(mesh.vertices, mesh.vertices)
    a, b = mesh.edges.T
    lengths = [np.linalg.norm(x[a] - x[b], axis=1) for x in (garment.position, mesh.vertices)]
    assert np.abs(lengths[0] / lengths[1] - 1).max() < 0.03
    assert np.abs(garment.position - before).max() < 1e-3


def test_what_is_held_all_over_goes_where_the_body_takes_it():
    mesh = hanging()
    garment = Alone(mesh, np.ones(mesh.vertex_count))
    garment.go(mesh.vertices, mesh.vertices + 0.1)
    np.testing.assert_array_equal(garment.position, mesh.vertices + 0.1)


def test_a_falling_sheet_stays_outside_a_ball():
    core, cloth = ball(0.12), lying(13, 13, 0.025, 0.14)
    # Vertices that no face uses are no part of the surface.
    surface = np.concatenate([[[0.0, 0.14, 0.0]], core.vertices])
    garment = GarmentDynamics(cloth, free(cloth), [ContactSurface(core.faces + 1, 0.004, 0.05)], GarmentConfig())
    for _ in range(20):
        garment.advance(SECONDS, (cloth.vertices, cloth.vertices), [(surface, surface)])
    assert garment.position[:, 1].min() < 0.08  # it drapes
    assert depths(core, garment.position).max() < 5e-4


def test_every_surface_keeps_its_own_margin():
    left, right = lying(9, 9), lying(9, 9)
    places = [left.vertices + [-0.2, 0, 0], right.vertices + [0.2, 0, 0]]
    patch = lying(3, 3, 0.01, 0.012)
    for side, margin in zip((-0.2, 0.2), (0.01, 0.003), strict=True):
        cloth = patch.with_vertices(patch.vertices + [side, 0, 0])
        touches = [ContactSurface(left.faces, 0.01, 0.02), ContactSurface(right.faces, 0.003, 0.02)]
        garment = GarmentDynamics(cloth, free(cloth), touches, GarmentConfig())
        for _ in range(20):
            garment.advance(SECONDS, (cloth.vertices, cloth.vertices), [(x, x) for x in places])
        np.testing.assert_allclose(garment.position[:, 1], margin, atol=1e-3)


@pytest.fixture(scope="module")
def person():
    return load_person(TOPOLOGY)


@pytest.mark.long
def test_a_take_starts_settled_swings_keeps_its_length_and_repeats(person):
    motion = Performance(person.betas, person.body.expression_names, seconds=0.2, seed=1)
    config = SimulationConfig(settle=0.3)
    take = simulate(person, motion, 3, config)
    np.testing.assert_array_equal(simulate(person, motion, 3, config).vertices, take.vertices)
    still = take.attachment == 1.0
    held_cloth = still & ((person.vertex_part == 1) | (person.vertex_part == 2))
    np.testing.assert_allclose(take.vertices[:, held_cloth], take.skinned[:, held_cloth], atol=1e-5)
    body = TriangleMesh(take.vertices[-1, : person.body.vertex_count], person.body.faces)
    for name, part, strain in (("upper", 1, 0.2), ("lower", 2, 0.06)):
        assert np.percentile(np.abs(free_edge_strain(person, take, name)), 99) < strain
        loose = (person.vertex_part == part) & ~still
        depth = depths(body, take.vertices[-1, loose])
        assert (depth > 1e-3).mean() < 0.01
        # The first step of a motion that starts from rest moves settled clothes little.
        assert np.linalg.norm(take.vertices[1, loose] - take.vertices[0, loose], axis=1).mean() < 0.02


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
