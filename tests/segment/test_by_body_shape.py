"""Hems, folds and the chain of states by which clothes are found without colours."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from smplxpp.core import TriangleMesh
from smplxpp.core.labels import HAIR, LABELS, LOWER, SHOE, SKIN, UPPER
from smplxpp.segment.by_body_chart import FOOT, HEAD, NECK, TRUNK, BodyChart
from smplxpp.segment.by_body_hems import Hems, roughness
from smplxpp.segment.by_body_layers import Layers
from smplxpp.segment.by_body_outfit import Outfit
from smplxpp.segment.by_body_prior import place_prior, standing_collar
from smplxpp.segment.by_body_rings import ARM_START, STEP, Rings
from smplxpp.segment.by_body_shape import Chain, ShapeEvidence, outfit_by_shape


def tube(distance) -> Hems:
    """Hems of a tube of 40 rings whose distance from the body is a function of place and angle."""
    rng = np.random.default_rng(0)
    place, turn = rng.uniform(0.0, 0.6, 40_000), rng.uniform(-np.pi, np.pi, 40_000)
    everywhere = np.ones(len(place), dtype=bool)
    noise = rng.normal(0.0, 0.001, len(place))
    return Hems.of(
        place,
        turn,
        tubes=(everywhere,),
        distance=distance(place, turn) + noise,
        area=np.ones(len(place)),
        start=0.0,
        count=40,
    )


def test_a_step_all_round_is_a_hem_and_one_on_a_side_is_none():
    hems = tube(lambda place, turn: 0.012 * (place > 0.3))
    assert hems.outwards[20] > 3.0 and hems.outwards[[10, 30]].max() < -1.0
    assert hems.inwards[20] < -1.0
    # A pocket over a third of the way round, and a limb that the body misses more and more.
    pocket = tube(lambda place, turn: 0.012 * ((place > 0.3) & (np.abs(turn) < 1.0)))
    flare = tube(lambda place, turn: 0.1 * np.maximum(place - 0.3, 0.0))
    assert pocket.outwards[20] < -1.0
    assert flare.outwards.max() < 0.5


def test_a_limb_that_swells_and_thins_has_no_hems():
    """A bare man whose arms and trunk no shape of the body has wore shirt and trousers: every swelling was a hem."""
    swollen = tube(lambda place, turn: 0.006 * np.sin(2.0 * np.pi * place / 0.22))
    assert max(swollen.outwards[3:-3].max(), swollen.inwards[3:-3].max()) < 0.5
    # A cuff of 10 mm on the same arm remains one.
    cuff = tube(lambda place, turn: 0.006 * np.sin(2.0 * np.pi * place / 0.22) + 0.01 * (place < 0.36))
    assert 22 <= int(cuff.inwards.argmax()) <= 26 and cuff.inwards.max() > 2.0


def test_a_roll_at_the_waist_is_no_end_of_a_garment():
    """A dress with a fold all round the waist was a blouse and a skirt: it steps out, and back in 3 cm above."""
    roll = tube(lambda place, turn: 0.012 * ((place > 0.3) & (place < 0.33)))
    out, into = roll.beside_rolls()
    assert roll.outwards[20] > 3.0 and roll.inwards[22] > 3.0
    assert out[20] < 0.5 and into[22] < 0.5
    # A garment that goes on above its hem keeps all of it.
    hem = tube(lambda place, turn: 0.012 * (place > 0.3))
    assert hem.beside_rolls()[0][20] == hem.outwards[20]


@pytest.mark.parametrize("hem", [False, True])
def test_what_goes_round_both_legs_is_a_dress_unless_it_ends_at_the_waist(hem):
    rings, none = 88, np.full(89, -3.0)
    place = STEP * np.arange(rings)
    distance = np.where(place < 0.5, 0.0, np.where(place < 0.9, 0.06, 0.012))
    apart = (place < 0.5).astype(np.float64)
    nothing = np.zeros((rings, 2))
    column = Rings(0.0, np.ones(rings), nothing, nothing, distance, np.full(rings, 0.005))
    out, into = none.copy(), none.copy()
    out[34] = 7.0  # the hem of the skirt
    if hem:
        out[59] = 4.5
    else:
        out[70], into[72] = 4.0, 4.5
    bare = np.zeros((45, 2))
    arm = Rings(ARM_START, np.ones(45), bare, bare, np.zeros(45), np.full(45, 0.003))
    cuff = np.full(46, -3.0)
    cuff[9] = 3.5
    found = outfit_by_shape(
        ShapeEvidence(column, arm, Hems(out, into), Hems(np.full(46, -3.0), cuff), -3.3, (0.5e-3, 0.7e-3), apart)
    )
    assert found.one_piece != hem


def test_what_hangs_far_off_feet_face_and_back_is_no_shoe_and_no_skin():
    """Hems of a hakama at the height of the shoes were shoes, what of a brim hangs over the face was skin, and so was
    the end of a ponytail of its colour."""
    nought = np.zeros(6)
    place = BodyChart(
        region=np.array([FOOT, FOOT, HEAD, HEAD, TRUNK, TRUNK]),
        height=np.array([0.05, 0.05, 1.6, 1.6, 1.44, 1.44]),
        reach=nought,
        azimuth=np.array([0.0, 0.0, 0.0, 0.0, 3.0, 3.0]),
        turn=nought,
        face_height=np.array([0.0, 0.0, 0.5, 0.5, -0.3, -0.3]),
        distance=np.array([0.01, 0.09, 0.01, 0.06, 0.01, 0.05]),
        side=np.ones(6, dtype=np.int64),
    )
    outfit = Outfit(0.09, 0.09, 1.0, 1.0, 0.1, {}, np.zeros((88, len(LABELS))), np.zeros(45))
    prior = place_prior(place, outfit, Layers.none(6), softness=0.035, body_softness=0.03)
    assert prior[0].argmax() == SHOE.id and prior[2].argmax() == SKIN.id
    assert prior[1, SHOE.id] < prior[1, LOWER.id] and prior[3].argmax() == HAIR.id
    assert prior[4, SKIN.id] > 0.3 and prior[5, SKIN.id] < 0.01 and prior[5, HAIR.id] > 0.3


@pytest.mark.parametrize("gap", [None, 0.0, 3.0])
def test_what_goes_all_round_a_neck_is_a_collar_and_no_hair(gap):
    """The turned-up collar of a fleece was hair, which stands off a neck behind and beside it, but never before it."""
    azimuth = np.linspace(-np.pi, np.pi, 200)
    nought = np.zeros(200)
    # Skin shows where there is a gap: at the throat, as below long hair, or behind, as above a shirt's collar.
    off = np.full(200, 0.03) if gap is None else np.where(np.abs(np.abs(azimuth) - gap) < 0.4, 0.002, 0.03)
    place = BodyChart(
        region=np.full(200, NECK),
        height=np.full(200, 1.49),
        reach=nought,
        azimuth=azimuth,
        turn=azimuth,
        face_height=nought,
        distance=off,
        side=np.ones(200, dtype=np.int64),
    )
    collar = standing_collar(place, np.full(200, 1e-4))
    assert collar.all() == collar.any() == (gap is None)
    outfit = Outfit(0.09, 0.09, 1.0, 1.0, 0.1, {}, np.zeros((88, len(LABELS))), np.zeros(45))
    prior = place_prior(place, outfit, Layers.none(200), softness=0.035, body_softness=0.03, collar=collar)
    behind = np.abs(azimuth) > 2.5
    assert (prior[behind, UPPER.id] > prior[behind, HAIR.id]).all() == collar.all()


def test_a_hem_may_lie_higher_on_one_side():
    tilted = tube(lambda place, turn: 0.012 * (place > 0.3 + 0.012 * np.sin(turn)))
    assert tilted.outwards[19:22].max() > 3.0


@pytest.mark.parametrize(("folds", "low", "high"), [(0.0, 0.0, 0.03e-3), (2e-3, 0.8e-3, 1.6e-3)])
def test_roughness_of_a_bent_sheet_with_folds(folds, low, high):
    """A quadric leaves nothing of a cylinder's flank; of folds of 2 mm, 4 cm apart, about their spread of 1.4 mm."""
    x, y = np.meshgrid(np.arange(0, 0.3, 0.006), np.arange(0, 0.3, 0.006), indexing="ij")
    z = -2.0 * (x - 0.15) ** 2 + folds * np.sin(2 * np.pi * y / 0.04)
    n = x.shape[1]
    first = (n * np.arange(n - 1)[:, None] + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + n, first + n + 1], 1), np.stack([first, first + n + 1, first + 1], 1)]
    )
    sheet = TriangleMesh(np.stack([x, y, z], axis=2).reshape(-1, 3), faces)
    inner = (np.abs(sheet.face_centers[:, :2] - 0.15) < 0.1).all(axis=1)
    assert low <= roughness(sheet, inner) <= high


def test_sums_of_a_chain_are_those_over_all_its_sequences():
    rng = np.random.default_rng(1)
    rings, states = 4, 6
    change = {(a, b): rng.uniform(0, 3, rings + 1) for a, b in ((0, 1), (0, 3), (1, 3), (3, 5), (1, 5))}
    chain = Chain(rng.uniform(0, 3, states), rng.uniform(0, 3, (rings, states)), change, rng.uniform(0, 3, states))
    total, share, best = 0.0, np.zeros((rings, states)), (np.inf, ())
    for path in product(range(states), repeat=rings):
        steps = [(r, path[r - 1], path[r]) for r in range(1, rings) if path[r] != path[r - 1]]
        if any((a, b) not in change for _, a, b in steps):
            continue
        cost = chain.start[path[0]] + chain.end[path[-1]] + sum(change[a, b][r] for r, a, b in steps)
        cost += sum(chain.stay[r, state] for r, state in enumerate(path))
        total += np.exp(-cost)
        share[np.arange(rings), path] += np.exp(-cost)
        best = min(best, (cost, path))
    forward, backward = chain.log_sums()
    np.testing.assert_allclose(np.exp(forward + backward), share, atol=1e-12)
    assert np.exp(forward[-1] - chain.end).sum() == pytest.approx(total)
    assert tuple(chain.cheapest()) == best[1]


def test_who_wears_no_shirt_has_no_sleeves():
    """Arms that keep a centimetre from the body, as they did of an unclothed man, were sleeves without a shirt."""

    def rings(start: float, count: int, distance: float) -> Rings:
        nothing = np.zeros((count, 2))
        return Rings(start, np.ones(count), nothing, nothing, np.full(count, distance), np.zeros(count))

    flat = [Hems(np.full(n + 1, -3.0), np.full(n + 1, -3.0)) for n in (88, 45)]
    seen = ShapeEvidence(
        rings(0.0, 88, 0.0), rings(ARM_START, 45, 0.012), flat[0], flat[1], -4.0, (0.15e-3, 0.12e-3), np.ones(88)
    )
    outfit = outfit_by_shape(seen)
    assert outfit.unclothed and outfit.cuff == ARM_START
