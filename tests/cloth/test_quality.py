"""How well simulated cloth holds: planted tears are found, said, and failed checks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.cloth import DriverConfig
from smplxpp.cloth.quality import ClothQuality, EdgeLengths, all_checks, merged, quality_from
from tests.cloth.persons import PART, standing
from tests.cloth.test_driver import QUICK, driver, garment, swaying


def statuses(quality: list[ClothQuality]) -> dict[str, str]:
    return {check.name.split(": ")[1]: check.status for check in all_checks(quality, "a test")}


def test_a_skirt_that_sways_holds_and_nothing_is_said():
    one = driver()
    for k in range(20):
        one.step(swaying(k / 30), 1 / 30)
    (found,) = one.quality
    assert found.frames == 20 and found.holds and one.notes == []
    assert 0.8 < found.longest < 1.25 and 0.8 < found.drawn < 1.6
    assert statuses([found]) == {"longest edge": "pass", "longest drawn edge": "pass", "inside the body": "pass"}


def test_an_edge_of_three_times_its_length_was_not_said_below_four():
    """A hem caught at a shoe was drawn to 3.45 times its length in frames that were used, and every check passed."""
    one = driver(replace(QUICK, most_stretch=100.0, most_drawn=100.0))
    one.step(standing(), 0.0)
    before = one.particles(PART)
    model = garment().model()
    free = np.flatnonzero(~garment().pinned)
    hem = free[before[free, 1].argmin()]
    drawn = before.copy()
    drawn[hem] += [0.0, -0.3, 0.0]
    one.place(PART, drawn)
    one.over(standing())
    (found,) = one.quality
    ends = drawn[model.edges]
    expected = (np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) / model.lengths).max()
    assert found.longest == pytest.approx(expected, rel=1e-4) and expected > 3.0
    assert found.drawn > 2.0 and not found.holds
    assert len(one.notes) == 1 and "tears" in one.notes[0] and f"{expected:.2f} x" in one.notes[0]
    assert statuses([found])["longest edge"] == "fail" and statuses([found])["longest drawn edge"] != "pass"
    # What is not used is forgotten.
    one.place(PART, before)
    one.measure_anew()
    one.over(standing())
    assert one.quality[0].holds and one.quality[0].frames == 1


def test_cloth_within_the_body_is_counted():
    one = driver(DriverConfig(ramp=0.0, hold=0.0))
    one.step(standing(), 0.0)
    particles = one.particles(PART)
    deep = np.flatnonzero(~garment().pinned & (particles[:, 1] > 0.8))
    before = one.quality[0]
    particles[deep] *= [0.7, 1.0, 0.7]
    one.place(PART, particles)
    one.measure_anew()
    one.over(standing())
    (found,) = one.quality
    assert before.inside < 0.05 < found.inside <= len(deep) / (~garment().pinned).sum() + 1e-6
    assert 0.005 < found.deepest < 0.06
    assert statuses([found])["inside the body"] in ("warn", "fail")


def test_a_simulation_that_broke_down_fails_although_the_cloth_is_on_the_body_again():
    one = driver(replace(QUICK, most_stretch=0.01))
    one.step(standing(), 0.0)
    (found,) = one.quality
    assert found.longest < 1.25 and found.resets > 0 and not found.holds
    assert statuses([found])["longest edge"] == "fail"


def test_figures_of_spans_together():
    a = ClothQuality(part="a", frames=1, longest=1.1, longest_at=0.5, inside=0.2, deepest=0.01, resets=1)
    b = ClothQuality(part="a", frames=3, longest=1.2, longest_at=2.0, inside=0.0, drawn=1.5)
    other = ClothQuality(part="b", frames=1)
    one, two = merged([a, other, b])
    assert two is other
    assert (one.frames, one.longest, one.longest_at, one.drawn, one.deepest, one.resets) == (4, 1.2, 2.0, 1.5, 0.01, 1)
    assert one.inside == pytest.approx(0.05)
    assert quality_from({**one.as_dict(), "newer": 1}) == one
    assert all_checks([ClothQuality(part="never")], "no frame") == []


def test_lengths_of_places_that_are_no_numbers_are_infinite():
    lengths = EdgeLengths(np.array([[0, 1]]), np.array([0.5]), 0.0)
    places = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    assert lengths.longest(places) == pytest.approx(2.0)
    assert lengths.longest(places * np.float32(np.nan)) == np.inf
    assert EdgeLengths(np.zeros((0, 2), int), np.zeros(0), 0.0).longest(places) == 0.0
