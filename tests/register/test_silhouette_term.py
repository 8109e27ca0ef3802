"""Distances to a mask's contour, and the gaps that are estimated from them."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.register.clothing import Gaps
from smplxpp.register.silhouette_term import Outline


def disc(height, width, center, radius):
    y, x = np.mgrid[:height, :width] + 0.5
    return np.round(255 * np.clip(radius - np.hypot(x - center[0], y - center[1]) + 0.5, 0, 1)).astype(np.uint8)


@pytest.mark.parametrize(("size", "factor"), [(400, 1), (1500, 2)])
def test_distance_to_a_disc(size, factor):
    center, radius = (0.52 * size, 0.47 * size), 0.2 * size
    outline = Outline.of(disc(size, size, center, radius))
    rng = np.random.default_rng(0)
    angle, off = rng.uniform(0, 2 * np.pi, 500), rng.uniform(-12, 12, 500) * factor
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance, gradient, known = outline.sample(np.array(center) + (radius + off)[:, None] * direction)
    assert known.all()
    assert np.abs(distance - off).max() < 0.8 * factor
    assert np.abs(np.mean(distance - off)) < 0.1 * factor
    along = np.einsum("na,na->n", gradient, direction)
    assert along.min() > 0.8 and along.mean() > 0.97


def test_what_is_far_is_not_known():
    outline = Outline.of(disc(300, 300, (150, 150), 60))
    _, _, known = outline.sample(np.array([[150.0, 150.0], [5.0, 5.0], [-400.0, 20.0], [150.0, 92.0]]))
    assert known.tolist() == [False, False, False, True]


def test_the_images_edge_is_no_contour():
    """Feet below the picture: their side is a contour, the cut is not."""
    mask = np.zeros((200, 200), np.uint8)
    mask[80:, 60:140] = 255
    outline = Outline.of(mask)
    at_cut, _, known = outline.sample(np.array([[100.0, 198.0]]))
    assert not known[0] or at_cut[0] < -20
    at_side, _, known = outline.sample(np.array([[63.0, 190.0]]))
    assert known[0] and at_side[0] == pytest.approx(-3.0, abs=0.3)


def test_nobody():
    assert Outline.of(np.zeros((50, 40), np.uint8)) is None


def test_gaps_are_medians_with_their_spread():
    rng = np.random.default_rng(1)
    tight, loose = rng.normal(0.012, 0.001, 200), rng.normal(0.05, 0.03, 200)
    place = np.repeat([3, 5, 6], [200, 200, 2])
    order = rng.permutation(402)
    gaps = Gaps.estimated(place[order], np.concatenate([tight, loose, [0.1, 0.1]])[order], 8, least=8, tight=0.004)
    assert gaps.median[3] == pytest.approx(0.012, abs=5e-4)
    assert gaps.spread[3] == pytest.approx(np.hypot(0.001, 0.004), rel=0.1)
    assert gaps.spread[5] == pytest.approx(0.03, rel=0.2)
    assert not np.isfinite(gaps.spread[[0, 6, 7]]).any()


def test_gaps_are_never_negative():
    gaps = Gaps.estimated(np.zeros(50, np.int64), np.full(50, -0.01), 1, least=8, tight=0.004)
    assert gaps.median[0] == 0.0
