"""Keypoints before they are fitted: sides, names that a body lacks, one camera alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.register import Observations, RegisterConfig
from smplxpp.register.keypoint_faults import exchanged, sides_are_exchanged
from smplxpp.register.keypoint_term import prepare_keypoints
from tests.register.people import keypoints, moving, ring

BODY = load_body()
FRAMES = 4


@pytest.fixture(scope="module")
def scene():
    person, cameras = moving(BODY, FRAMES), ring(5)
    return person, cameras, keypoints(BODY, person, cameras, px=1.0)


def observed(cameras, seen):
    return Observations(tuple(range(FRAMES)), cameras, keypoints=seen)


def test_sides_exchanged_in_all_views_are_named_and_exchanged_back(scene):
    person, cameras, seen = scene
    joints = BODY.forward(person).joints
    assert not sides_are_exchanged(BODY.joint_names, joints)
    wrong = prepare_keypoints(BODY, observed(cameras, exchanged(seen)), RegisterConfig())
    right = prepare_keypoints(BODY, observed(cameras, seen), RegisterConfig())
    assert not right.notes
    assert any("left and right are exchanged in all views" in problem for problem in wrong.notes)
    assert np.nanmax(np.abs(wrong.points - right.points)) < 1e-6


def test_a_person_without_feet_and_face_is_left_as_she_is(scene):
    person, _, _ = scene
    joints = BODY.forward(person).joints.copy()
    names = list(BODY.joint_names)
    joints[:, [names.index(name) for name in ("left_foot", "right_foot", "jaw")]] = np.nan
    assert not sides_are_exchanged(names, joints)


def test_names_that_the_body_lacks_are_told(scene):
    _, cameras, seen = scene
    renamed = {c: replace(k, names=("tail", *k.names[1:])) for c, k in seen.items()}
    found = prepare_keypoints(BODY, observed(cameras, renamed), RegisterConfig())
    assert "tail" not in found.landmarks.names
    assert any("tail" in problem for problem in found.notes)


def test_one_camera_alone_has_no_points(scene):
    _, cameras, seen = scene
    found = prepare_keypoints(BODY, observed(cameras, {"C1": seen["C1"]}), RegisterConfig())
    assert np.isnan(found.points).all()
    assert found.keypoints["C1"].confidence.all()


def test_a_stranger_in_one_view_is_not_fitted(scene):
    _, cameras, seen = scene
    other = replace(seen["C3"], points=seen["C3"].points + np.array([90.0, -40.0]))
    found = prepare_keypoints(BODY, observed(cameras, {**seen, "C3": other}), RegisterConfig())
    assert "C3" not in found.keypoints or not found.keypoints["C3"].confidence.any()
    assert any("C3" in problem for problem in found.notes)
