"""Patterns and lengths of the skirt: each says of a point of the cloth what it may; by default plaid, to the knees."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.core import TriangleMesh, row_lengths
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops
from smplxpp.people.cloth_mesh import ClothMesh, lengthened
from smplxpp.people.fixture_person import load_person, read_layers
from smplxpp.people.textures import (
    SKIRT_GIRTH,
    SKIRT_PATTERNS,
    SKIRT_RADIUS,
    around_and_along,
    evenly_around,
    skirt_colors,
)
from smplxpp.synth.simulate import attachment

TOPOLOGY = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person" / "geometry" / "topology.npz"


def colors(name: str, around=0.0, along=0.0) -> np.ndarray:
    at = np.stack(np.broadcast_arrays(np.asarray(around, float), np.asarray(along, float)), axis=-1).reshape(-1, 2)
    return SKIRT_PATTERNS[name](at)


LINE = np.linspace(-0.4, 0.4, 400)


@pytest.mark.parametrize("name", SKIRT_PATTERNS)
def test_patterns_are_colours_and_close_around(name):
    every = colors(name, LINE[:, None], LINE[None])
    assert np.isfinite(every).all() and every.min() >= 0 and every.max() <= 255
    left, right = (colors(name, side * 0.5 * SKIRT_GIRTH, LINE) for side in (-1, 1))
    np.testing.assert_allclose(left, right, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "around", "along"),
    [
        ("plaid", True, True),
        ("stripes", True, False),
        ("hoops", False, True),
        ("dots", True, True),
        ("plain", False, False),
    ],
)
def test_what_a_pattern_tells(name, around, along):
    assert (np.ptp(colors(name, LINE, 0.0), axis=0).max() > 50) == around
    assert (np.ptp(colors(name, 0.0, LINE), axis=0).max() > 50) == along


def test_dots_are_staggered():
    apart = SKIRT_GIRTH / 26
    assert (colors("dots", 0.0, 0.0) == colors("dots", apart, 0.0)).all()
    np.testing.assert_allclose(colors("dots", 0.0, 0.0), colors("dots", 0.5 * apart, 0.05))
    assert not np.allclose(colors("dots", 0.0, 0.0), colors("dots", 0.5 * apart, 0.0))


def test_places_on_a_skirt():
    at = around_and_along(np.array([[0.0, 0.3, 0.2], [0.2, -0.1, 0.0], [-0.2, 0.0, 0.0]]))
    np.testing.assert_allclose(at, [[0.0, 0.3], [0.5 * np.pi * SKIRT_RADIUS, -0.1], [-0.5 * np.pi * SKIRT_RADIUS, 0.0]])


def test_threads_are_in_all_cloth_but_plain():
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3)).astype(np.float32)
    assert np.ptp(skirt_colors(points, 0.0, "plain"), axis=0).max() == 0
    flat = SKIRT_PATTERNS["dots"](around_and_along(points))
    thread = skirt_colors(points, 0.0, "dots") / flat
    assert 0.01 < np.abs(thread - 1.0).mean() < 0.2


def test_the_person_wears_the_pattern():
    person = load_person(TOPOLOGY)
    skirt = np.flatnonzero(person.vertex_part == 2)[:300]
    points = person.tpose.vertices[skirt]
    plaid, dots = (
        replace(person, skirt_pattern=name).colors(points, person.vertex_part[skirt], person.vertex_label[skirt])
        for name in ("plaid", "dots")
    )
    np.testing.assert_array_equal(person.colors(points, person.vertex_part[skirt], person.vertex_label[skirt]), plaid)
    assert (plaid != dots).any(axis=1).mean() > 0.9


def cone(columns: int, rows: int) -> ClothMesh:
    """A skirt about y from 0 down to -0.3, of radius 0.2 at the waist and 0.29 at the hem, columns and rows even."""
    angle, down = np.meshgrid(np.arange(columns) * 2 * np.pi / columns, np.linspace(0.0, 0.3, rows))
    radius = 0.2 + 0.3 * down
    vertices = np.stack([radius * np.sin(angle), -down, radius * np.cos(angle)], axis=-1).reshape(-1, 3)
    a = (columns * np.arange(rows - 1)[:, None] + np.arange(columns)).ravel()
    b = (columns * np.arange(rows - 1)[:, None] + (np.arange(columns) + 1) % columns).ravel()
    faces = np.concatenate([np.stack([a, a + columns, b], 1), np.stack([b, a + columns, b + columns], 1)])
    right = np.clip(0.5 + vertices[:, :1], 0, 1)
    return ClothMesh(vertices, faces, np.hstack([right, 1 - right]))


def test_a_longer_cone_is_the_same_cone():
    old = cone(90, 20)
    new = lengthened(old, -0.5, 0.0)
    count = len(old.vertices)
    np.testing.assert_array_equal(new.vertices[:count], old.vertices)
    np.testing.assert_array_equal(new.faces[: len(old.faces)], old.faces)
    x, y, z = new.vertices[count:].T
    # Between vertices of the old hem the surface is a chord's, 0.2 mm within the circle.
    np.testing.assert_allclose(np.hypot(x, z), 0.2 - 0.3 * y, atol=5e-4)
    assert y.min() == pytest.approx(-0.5) and y.max() < -0.3
    np.testing.assert_allclose(new.weights.sum(axis=1), 1.0)
    # One sheet with the two borders of a skirt, faces outwards, and no edge much longer than the old ones.
    mesh = new.mesh
    assert len(border_loops(mesh.faces)) == 2 and mesh.edges_with_counts[1].max() == 2
    assert (mesh.face_normals * (mesh.face_centers * [1.0, 0.0, 1.0])).sum(axis=1).min() > 0
    lengths = [row_lengths(np.diff(m.vertices[m.edges], axis=1)[:, 0]).max() for m in (mesh, old.mesh)]
    assert lengths[0] < 1.1 * lengths[1]


def test_dots_stay_as_far_apart_as_the_cloth_is_wide():
    hem = cone(360, 2).vertices[-360:] * [2.0, 1.0, 1.0]  # an ellipse, half of whose length is in its flat front
    at = evenly_around(hem, hem)
    steps = row_lengths(np.roll(hem, -1, axis=0) - hem)
    girth = steps.sum() / SKIRT_GIRTH
    np.testing.assert_allclose(at[:, 2], girth)
    np.testing.assert_allclose(np.diff(np.sort(at[:, 0])), np.roll(steps, 179)[:-1] / girth, atol=1e-5)
    np.testing.assert_allclose(evenly_around(0.5 * hem, hem)[:, 2], 0.5 * girth)
    np.testing.assert_allclose(evenly_around(0.5 * hem, hem)[:, 0], at[:, 0], atol=1e-9)
    wide = np.stack([LINE, 0 * LINE, 0 * LINE + 2.0], axis=1)
    shown = [(SKIRT_PATTERNS["dots"](rows)[:, 0] > 140).mean() for rows in (wide[:, :2], wide)]
    assert shown[1] == pytest.approx(0.5 * shown[0], abs=0.02)


@pytest.mark.long
def test_a_skirt_to_the_calves_hangs_from_the_waist_alone():
    knee, calf = read_layers(TOPOLOGY), read_layers(TOPOLOGY, skirt_length="calf")
    person = load_person(TOPOLOGY, skirt_length="calf")
    added = len(calf["v_tpose"]) - len(knee["v_tpose"])
    first, last = np.flatnonzero(knee["vertex_part"] == 2)[[0, -1]]
    for name in ("v_tpose", "weights", "vertex_label", "exprdirs"):
        np.testing.assert_array_equal(calf[name][: last + 1], knee[name][: last + 1])
        np.testing.assert_array_equal(calf[name][last + 1 + added :], knee[name][last + 1 :])
    old, new = knee["faces"][knee["face_part"] > 2], calf["faces"][calf["face_part"] > 2]
    np.testing.assert_array_equal(old + added, new)
    hem = person.tpose.vertices[last + 1 : last + 1 + added]
    joint = person.joints
    assert hem[:, 1].min() == pytest.approx(0.5 * (joint["left_knee"][1] + joint["left_ankle"][1]), abs=1e-3)
    count = person.body.vertex_count
    body = TriangleMesh(person.tpose.vertices[:count], person.body.faces)
    assert SignedDistanceField(body, solid=True).query(hem).distance.min() > 0.004
    hold = attachment(person)
    assert (hold[last + 1 : last + 1 + added] == 0.0).all()
    np.testing.assert_array_equal(hold[: last + 1], attachment(load_person(TOPOLOGY))[: last + 1])
    own = person.vertex_part == 2
    dotted = replace(person, skirt_pattern="dots")
    seen = dotted.colors(person.tpose.vertices[own], person.vertex_part[own], person.vertex_label[own])
    below = person.tpose.vertices[own, 1] < -0.33
    assert 0.1 < (seen[below, 0] > 140).mean() < 0.25 and first < last
