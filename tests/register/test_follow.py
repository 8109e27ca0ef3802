"""A body followed through frames by masks alone."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core.errors import InputError
from smplxpp.register import Observations, RegisterConfig
from smplxpp.register.follow import disagreement, follow, predicted
from tests.register.people import masks, moving, ring, vertex_error_mm

BODY = load_body()
FRAMES = 5
SMALL = RegisterConfig(scan_samples=1500, rim_samples=1500)


@pytest.fixture(scope="module")
def person():
    return moving(BODY, FRAMES)


@pytest.fixture(scope="module")
def observed(person):
    cameras = ring(5, height=320)
    seen = masks(BODY, person, cameras)
    bare = np.ones(BODY.vertex_count, dtype=bool)
    return Observations(tuple(range(FRAMES)), cameras, mask=lambda name, frame: seen[name, frame], fps=20.0, bare=bare)


@pytest.mark.long
def test_from_the_middle_to_both_ends(person, observed):
    told = []
    found = follow(BODY, observed, person.frame(2), at=2, config=SMALL, progress=lambda what, share: told.append(share))
    still = person.select([2] * FRAMES)
    assert vertex_error_mm(BODY, found, person) < 0.35 * vertex_error_mm(BODY, still, person)
    assert vertex_error_mm(BODY, found, person) < 20.0
    assert (found.betas == found.betas[0]).all(axis=1).mean() >= 0.2 and np.ptp(found.betas, axis=0).max() < 0.05
    assert told == sorted(told) and told[-1] == 1.0


def test_the_right_body_disagrees_least(person, observed):
    own = [disagreement(BODY, observed, 1, person.frame(k)) for k in range(FRAMES)]
    assert int(np.argmin(own)) == 1 and own[1] < 0.05
    assert disagreement(BODY, Observations((0,)), 0, person.frame(0)) == 0.0


def test_motion_goes_on(person):
    past = [person.frame(0), person.frame(1)]
    np.testing.assert_allclose(
        predicted(BODY, past, 1.0).transl[0], 2 * person.transl[1] - person.transl[0], atol=1e-12
    )
    np.testing.assert_allclose(predicted(BODY, past, 0.0).full_pose, person.full_pose[1:2], atol=1e-9)
    assert predicted(BODY, past[:1], 0.8) is past[0]


def test_a_frame_that_is_not_there(person, observed):
    with pytest.raises(InputError, match="follow"):
        follow(BODY, observed, person.frame(2), at=9)
