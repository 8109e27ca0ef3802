"""Patterns of the skirt: each says of a point of the cloth what it may, and the default is the old plaid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.people.fixture_person import load_person
from smplxpp.people.textures import SKIRT_GIRTH, SKIRT_PATTERNS, SKIRT_RADIUS, around_and_along, skirt_colors

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
