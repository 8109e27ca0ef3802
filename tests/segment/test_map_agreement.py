"""A label map that contradicts the other views is left out; where nobody knows who errs, none is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.core import LOWER, UPPER, InputError, TriangleMesh
from smplxpp.segment import vote_in_agreement, vote_on_faces
from tests.segment.views import halves, sphere, views_of


@pytest.fixture(scope="module")
def ball() -> TriangleMesh:
    return sphere()


@pytest.fixture(scope="module")
def truth(ball) -> np.ndarray:
    return halves(ball)


def _swapped(labels: np.ndarray) -> np.ndarray:
    return np.select([labels == UPPER.id, labels == LOWER.id], [LOWER.id, UPPER.id], labels)


def test_views_that_agree_vote_as_they_do_without_the_check(ball, truth):
    views = views_of(ball, truth)
    agreed = vote_in_agreement(ball, views)
    assert not agreed.left_out
    np.testing.assert_allclose(agreed.votes, vote_on_faces(ball, views), atol=1e-12)


@pytest.mark.parametrize("bad", [(0,), (1, 4)])
def test_maps_of_something_else_are_named_and_do_not_vote(ball, truth, bad):
    views = [
        (replace(camera, name=f"Cam{k}"), _swapped(labels) if k in bad else labels)
        for k, (camera, labels) in enumerate(views_of(ball, truth))
    ]
    agreed = vote_in_agreement(ball, views)
    assert set(agreed.left_out) == {f"Cam{k}" for k in bad}
    assert all(share < 0.5 for share in agreed.left_out.values())
    rest = [view for k, view in enumerate(views) if k not in bad]
    np.testing.assert_allclose(agreed.votes, vote_on_faces(ball, rest), atol=1e-12)


def test_of_two_views_that_contradict_each_other_none_is_left_out(ball, truth):
    (camera, labels), other = views_of(ball, truth)[0], views_of(ball, truth)[1]
    views = [(camera, _swapped(labels)), other]
    assert not vote_in_agreement(ball, views).left_out


def test_noise_in_every_map_leaves_none_out(ball, truth):
    rng = np.random.default_rng(0)
    views = views_of(ball, truth)
    for _, labels in views:
        wrong = (labels >= 0) & (rng.random(labels.shape) < 0.6)
        labels[wrong] = rng.integers(0, 6, int(wrong.sum()))
    assert not vote_in_agreement(ball, views).left_out


def test_maps_that_show_nothing_of_the_scan_are_refused(ball, truth):
    views = [(camera, np.full_like(labels, -1)) for camera, labels in views_of(ball, truth)]
    with pytest.raises(InputError, match="no labelled pixel"):
        vote_in_agreement(ball, views)
