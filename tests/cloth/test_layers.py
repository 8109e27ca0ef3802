"""Two loose garments over each other stay so while they swing."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.cloth import ClothDriver, DriverConfig, Garment, GarmentConfig, cut_garment
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from tests.cloth.persons import OVER, PART, person, standing

QUICK = DriverConfig(ramp=0.2, hold=0.1)
FPS = 30


def garments() -> list[Garment]:
    config = GarmentConfig(spacing=0.05, collider_spacing=0.04)
    return [cut_garment(person(layers=2), part, standing(), config) for part in (PART, OVER)]


def kicking(t: float) -> BodyParams:
    """A leg lifted fast to the front, and down again, which drives the inner skirt into the outer one."""
    return standing(lifted=0.9 * np.sin(np.pi * 1.5 * t) ** 2, swung=0.3 * np.sin(np.pi * t) ** 2)


def depths(inner: ClothDriver, outer: ClothDriver, *, seconds: float = 1.2) -> np.ndarray:
    """(frames, n) how deep each particle of the outer skirt is under the inner one, metres; outside: 0."""
    drivers = {id(one): one for one in (inner, outer)}.values()
    (skirt,) = (one for one in inner.garments if one.part == PART)
    found = []
    for k in range(round(seconds * FPS) + 1):
        for one in drivers:
            one.step(kicking(k / FPS), 1 / FPS)
        surface = SignedDistanceField(TriangleMesh(inner.particles(PART).astype(float), skirt.rest.faces), solid=False)
        where = surface.query(outer.particles(OVER).astype(float))
        found.append(np.where(where.on_border, 0.0, np.maximum(-where.distance, 0.0)))
    return np.array(found)


@pytest.mark.long
def test_garments_that_touch_each_other_do_not_fold_into_themselves():
    template, both = person(layers=2), garments()
    layered, alone = ClothDriver(template, both, QUICK), ClothDriver(template, both[:1], QUICK)
    nearest = []
    for driver in (layered, alone):
        own = []
        for k in range(13):
            driver.step(kicking(k / FPS), 1 / FPS)
            own.append(near_itself(both[0], driver.particles(PART)))
        nearest.append(np.min(own))
    assert nearest[0] > 0.9 > 0.6 > nearest[1]


def near_itself(garment: Garment, x: np.ndarray) -> np.ndarray:
    """Of free particles: the distance to the nearest that no edge joins to them, over the spacing or that at rest."""
    away = np.linalg.norm(x[:, None] - x[None], axis=2)
    away[tuple(garment.rest.edges.T)] = away[tuple(garment.rest.edges[:, ::-1].T)] = np.inf
    np.fill_diagonal(away, np.inf)
    kept = np.minimum(garment.model().apart, garment.config.spacing)
    return (away.min(axis=1) / kept)[~garment.pinned]


@pytest.mark.long
def test_an_outer_garment_stays_outside_an_inner_one():
    template, both = person(layers=2), garments()
    together = ClothDriver(template, both, QUICK)
    apart = [ClothDriver(template, [one], QUICK) for one in both]
    known, unknown = depths(together, together), depths(*apart)
    assert not any(word in note for note in together.notes for word in ("broke down", "restart"))
    # Coarse cloth in a kick: a hundredth of the particles may be through for a moment, not the garment.
    assert np.quantile(known, 0.99) < 0.005 < 0.015 < np.quantile(unknown, 0.99)
    assert known.max() < 0.5 * unknown.max()
