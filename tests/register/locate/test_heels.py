"""Feet that lie below the floor of the scan are lifted on heels; others stay."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import BodyParams, ignore_progress
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.heels import _with_shorter_legs, lift_heels, on_heel, settle_feet
from smplxpp.register.locate.search import LocateConfig, Search

BODY = load_body()
FLAT = BodyState.of_params(BODY, BodyParams.rest(betas=np.zeros(BODY.num_betas), expressions=BODY.num_expressions))
NAMES = list(BODY.joint_names)


def _search(state: BodyState, *, points: int = 1500) -> Search:
    """A search in the surface of a body without clothes."""
    mesh = BODY.mesh(BODY.forward(state.to_params(BODY)).vertices[0])
    config = LocateConfig(coarse_points=400, fine_points=points)
    return Search(Kinematics(BODY), mesh, config, None, ignore_progress)


@pytest.fixture(scope="module")
def flat() -> Search:
    return _search(FLAT)


def _places(search: Search, state: BodyState, *joints: str) -> np.ndarray:
    return search.kinematics.posture(state, 0).joints[[NAMES.index(joint) for joint in joints]]


def test_a_heel_raises_the_ankle_by_its_height_and_turns_the_foot_down_by_its_pitch(flat):
    lifted = on_heel(flat, FLAT, "left", (0.06, 40.0, 0.0))
    joints = ("left_hip", "left_ankle", "left_foot", "right_ankle")
    (hip, ankle, foot, other), (_, ankle0, foot0, other0) = (_places(flat, one, *joints) for one in (lifted, FLAT))
    assert np.linalg.norm(ankle - hip) == pytest.approx(np.linalg.norm(ankle0 - hip) - 0.06, abs=2e-3)
    np.testing.assert_allclose(ankle, ankle0 + [0.0, 0.06, 0.0], atol=0.012)
    cosine = (foot - ankle) @ (foot0 - ankle0) / (np.linalg.norm(foot - ankle) * np.linalg.norm(foot0 - ankle0))
    assert np.degrees(np.arccos(cosine)) == pytest.approx(40.0, abs=3.0)
    np.testing.assert_array_equal(other, other0)


def test_feet_on_the_floor_stay(flat):
    found = flat.polished("rest", FLAT, None, steps=1)
    assert lift_heels(flat, found) is found


@pytest.mark.long
def test_legs_that_came_out_too_long_are_lifted_on_their_heels(flat):
    """A woman in pumps: her feet lay flat below the floor, and her legs were as long as without heels."""
    truth = on_heel(flat, on_heel(flat, FLAT, "left", (0.10, 35.0, -25.0)), "right", (0.10, 35.0, -25.0))
    search = _search(truth)
    lost = search.polished("flat", FLAT, None, steps=0)
    found = lift_heels(search, lost)
    assert found.cost < lost.cost - 0.05
    assert _off(search, found.state, truth) < 0.5 * _off(search, lost.state, truth) < 0.08


@pytest.mark.long
def test_toes_of_a_lifted_foot_are_bent_as_its_shoe_is(flat):
    """The pose prior kept toes straight, so that they came out below the shoe's tip."""
    truth = on_heel(flat, FLAT, "left", (0.08, 40.0, -45.0))
    search = _search(truth, points=5000)
    straight = search.polished("straight", on_heel(flat, FLAT, "left", (0.08, 30.0, 0.0)), None, steps=0)
    settled = settle_feet(search, straight)
    assert settled.misfit.total < straight.misfit.total and settled.pose_cost == straight.pose_cost
    toes = settled.state.rotations[0, NAMES.index("left_foot")]
    assert np.degrees(np.arctan2(-toes[1, 2], toes[2, 2])) == pytest.approx(-45.0, abs=15.0)
    np.testing.assert_array_equal(
        settled.state.rotations[0, NAMES.index("right_ankle")], straight.state.rotations[0, NAMES.index("right_ankle")]
    )
    assert settle_feet(flat, flat.polished("flat", FLAT, None, steps=0)).state is FLAT


@pytest.mark.long
def test_a_foot_that_ends_below_its_sole_gets_a_shorter_leg(flat):
    """A walking woman's front foot lay 30 mm below the sole of her pump, where no turn of it could lift it."""
    heel = (0.0, 35.0, -25.0)
    truth = on_heel(flat, _with_shorter_legs(flat, FLAT, 0.03), "left", heel)
    search = _search(truth, points=1500)
    low = search.polished("low", on_heel(flat, FLAT, "left", heel), None, steps=0)
    settled = settle_feet(search, low)
    right, before, after = (_places(search, state, "left_foot")[0, 1] for state in (truth, low.state, settled.state))
    assert right - before > 0.025 and abs(right - after) < 0.008


def test_straight_legs_that_are_too_long_get_shorter_and_the_rest_of_the_body_stays():
    search = _search(FLAT)
    short = _with_shorter_legs(search, FLAT, 0.04)
    before, after = (search.kinematics.posture(one, 0).joints for one in (FLAT, short))
    at = {
        name: NAMES.index(name) for name in ("pelvis", "head", "left_hip", "left_ankle", "left_wrist", "left_shoulder")
    }
    legs = [np.linalg.norm(joints[at["left_hip"]] - joints[at["left_ankle"]]) for joints in (before, after)]
    assert 0.015 < legs[0] - legs[1] < 0.045
    np.testing.assert_allclose(after[0], before[0], atol=1e-9)
    assert np.linalg.norm(after[at["head"]] - before[at["head"]]) < 0.012


def _off(search: Search, state: BodyState, truth: BodyState) -> float:
    """Mean distance of the left ankle and foot from where they are, metres."""
    places = [_places(search, one, "left_ankle", "left_foot") for one in (state, truth)]
    return float(np.linalg.norm(places[0] - places[1], axis=1).mean())
