"""The outline of clothes from rings of colours and distances, and the colour of skin."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
import pytest

from smplxpp.core.labels import LABELS
from smplxpp.segment.by_body_colors import fit_skin
from smplxpp.segment.by_body_outfit import NAT, RUNS, OutfitConfig, find_outfit, label_shares
from smplxpp.segment.by_body_rings import ARM_START, COLUMN_END, STEP, Rings, cloth_against_skin


def test_a_coat_to_the_knees_ends_over_trousers():
    """A doctor's coat was shirt and skirt, and her blue trousers were shoes."""
    places = STEP * np.arange(round(COLUMN_END / STEP))
    hem = 0.45
    # Two of ten shades.
    shade = np.where(places < hem, 1.0, 8.0)
    spread = np.exp(-0.5 * ((np.arange(10) - shade[:, None]) / 1.2) ** 2)
    ones = np.ones(len(places))
    colors, skin = spread / spread.sum(axis=1, keepdims=True), np.outer(ones, [0.0, 4.0])
    column = Rings(0.0, ones, colors, skin, np.where(places < hem, 0.015, 0.06), 0.003 * ones)
    arm = Rings(ARM_START, ones[:45], column.colors[-45:], column.skin[:45], column.distance[:45], column.spread[:45])
    # Mean of five rings of what is 1 where the surface goes round each leg.
    apart = np.convolve(places < hem, np.ones(5) / 5, mode="same")
    found = find_outfit(column, arm, OutfitConfig(), misfit=0.005, apart=apart)
    assert found.upper_start == found.lower_end == pytest.approx(hem, abs=0.02) and found.shoe_top < 0.2
    # Where nothing goes round each leg there are no trousers.
    assert not find_outfit(column, arm, OutfitConfig(), misfit=0.005, apart=0.0 * apart).has_lower


def test_a_distance_on_the_body_is_skin_and_a_centimetre_above_it_cloth():
    """Densities against numbers by hand, and no jump where the body itself is uncertain."""
    ratio = cloth_against_skin(np.array([0.0, 0.0035, 0.014, 0.03]), np.zeros(4))
    by_hand = np.log(14 / 49 * np.exp(-2.0)) - np.log(0.5 / (8 * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (14 / 8) ** 2))
    assert ratio[0] < -3.0 and abs(ratio[1]) < 0.2 and ratio[3] == 3.0
    assert ratio[2] == pytest.approx(by_hand, abs=1e-6)
    wide = cloth_against_skin(np.array([0.014]), np.array([0.02]))
    assert 0.0 < wide[0] < ratio[2]


def test_bare_arms_in_changing_light_are_no_sleeves():
    """A girl's bare arms, in shades of skin from the shoulder to the wrist with stains on each, were sleeves."""
    count = 45
    shade = np.linspace(1.0, 3.0, count)
    colors = np.exp(-0.5 * ((np.arange(5) - shade[:, None]) / 0.9) ** 2)
    colors = np.hstack([colors / colors.sum(axis=1, keepdims=True), np.zeros((count, 1))])
    skin = np.tile([3.0, 0.45], (count, 1))
    arm = Rings(ARM_START, np.ones(count), colors, skin, np.full(count, 0.002), np.full(count, 0.005))
    rings = round(COLUMN_END / STEP)
    red = np.tile(np.eye(6)[5], (rings, 1))
    shirt = Rings(0.0, np.ones(rings), red, np.tile([0.0, 3.9], (rings, 1)), np.full(rings, 0.015), np.zeros(rings))
    assert find_outfit(shirt, arm, OutfitConfig(), misfit=0.008).cuff <= 0.0


@pytest.mark.parametrize("ball_is_a_thing", [True, False])
def test_what_a_hand_holds_does_not_give_the_colour_of_skin(ball_is_a_thing):
    # 100 faces of each: the face with as much brown hair, the left hand, and the right hand behind a brown ball.
    rng = np.random.default_rng(0)
    skin, brown = np.array([0.75, 0.04, 0.05]), np.array([0.4, 0.03, 0.03])
    lab = np.repeat([skin, brown, skin, skin, brown, brown], (100, 100, 100, 20, 80, 100), axis=0)
    lab = lab + rng.normal(0, 0.005, lab.shape)
    rows = np.arange(500)
    face, left, right = rows < 200, (rows >= 200) & (rows < 300), (rows >= 300)
    area = np.ones(500)
    if ball_is_a_thing:
        area[320:] = 0.0
    else:
        face = face & (rows < 150)
    found = fit_skin(lab, face, (left, right), area)
    assert found.found and found.hands
    np.testing.assert_allclose(found.center, skin, atol=0.01)


def test_gloves_are_no_skin():
    skin, glove = np.array([0.75, 0.04, 0.05]), np.array([0.3, 0.0, 0.0])
    lab = np.repeat([skin, glove], 100, axis=0) + np.random.default_rng(0).normal(0, 0.005, (200, 3))
    rows = np.arange(200)
    found = fit_skin(lab, rows < 100, ((rows >= 100) & (rows < 150), rows >= 150), np.ones(200))
    assert found.hands is False
    np.testing.assert_allclose(found.center, skin, atol=0.01)


def test_shares_of_labels_are_sums_over_all_outlines():
    rng = np.random.default_rng(0)
    rings = 5
    there = np.triu(np.ones((rings + 1, rings + 1), dtype=bool))
    order = [np.where(there, rng.uniform(0, 20, there.shape), np.inf) for _ in RUNS]
    expected, total = np.zeros((rings, len(LABELS))), 0.0
    for inner in combinations_with_replacement(range(rings + 1), len(RUNS) - 1):
        cuts = (0, *inner, rings)
        weight = np.exp(-sum(cost[a, b] for cost, a, b in zip(order, cuts[:-1], cuts[1:], strict=True)) / NAT)
        total += weight
        for label, a, b in zip(RUNS, cuts[:-1], cuts[1:], strict=True):
            expected[a:b, label.id] += weight
    shares = label_shares(order)
    np.testing.assert_allclose(shares, expected / total, atol=1e-12)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)


@pytest.mark.parametrize(("boots", "fading"), [(False, 0.15), (False, 0.12), (True, 0.15)])
def test_light_that_fades_along_trousers_is_no_top_of_boots(boots, fading):
    """A real man in black had boots: light faded along his trousers more than it changed at his shoes."""
    places = STEP * np.arange(round(COLUMN_END / STEP))
    # Shade among 30 neighbouring ones: shoes 0 to 2; trousers from 4 on, lighter by one every 12 or 15 cm; shirt.
    shade = np.where(places < 0.09, 1.0, 4.0 + np.clip(places - 0.09, 0.0, 0.9) / fading)
    shade = np.where(places > 0.96, 25.0, shade)
    if boots:
        shade = np.where(places < 0.40, 1.0, 12.0)
    spread = np.exp(-0.5 * ((np.arange(30) - shade[:, None]) / 1.2) ** 2)
    ones = np.ones(len(places))
    column = Rings(
        0.0, ones, spread / spread.sum(axis=1, keepdims=True), np.outer(ones, [0.0, 4.0]), 0.012 * ones, 0.003 * ones
    )
    arm = Rings(ARM_START, ones[:45], column.colors[-45:], column.skin[:45], column.distance[:45], column.spread[:45])
    found = find_outfit(column, arm, OutfitConfig(), misfit=0.005)
    assert found.shoe_top == pytest.approx(0.40 if boots else 0.09, abs=0.02)
