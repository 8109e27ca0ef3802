"""Landmarks placed by hand: files, what a registration makes of them, and what it makes of wrong ones."""

from __future__ import annotations

import json

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec
from smplxpp.register import Observations, RegisterConfig, register
from smplxpp.register.landmarks import LandmarkModel, read_landmarks, write_landmarks
from tests.register.people import moving, vertex_error_mm
from tests.register.test_fit import SMALL, dressed

BODY = load_body()
EIGHT = ("nose", "neck", "pelvis", "left_shoulder", "right_shoulder", "left_wrist", "right_wrist", "left_ankle")
MANY = (*EIGHT, "right_ankle", "left_elbow", "right_elbow", "left_knee", "right_knee", "left_hip", "right_hip")


@pytest.fixture(scope="module")
def person():
    return moving(BODY, 6).select([2])


def placed(person: BodyParams, names, *, metres: float = 0.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Where a hand puts them: the points themselves, with errors of this standard deviation."""
    posed = BODY.forward(person).frame(0)
    points = LandmarkModel.of(BODY, names).points(posed.vertices, posed.joints)
    points = points + np.random.default_rng(seed).normal(0, metres, points.shape)
    return dict(zip(names, points, strict=True))


def fitted(points, **observed):
    return register(BODY, Observations((0,), landmarks={0: points}, **observed), SMALL)


def joint_error_mm(found: BodyParams, true: BodyParams) -> float:
    a, b = (BODY.forward(params).joints[0, :22] for params in (found, true))
    return 1e3 * np.linalg.norm(a - b, axis=1).mean()


def test_many_exact_landmarks_give_the_pose(person):
    fit = fitted(placed(person, MANY))
    assert joint_error_mm(fit.params, person) < 25.0
    assert fit.residuals["landmarks_mm"][0] < 4.0 and not fit.notes


@pytest.mark.long
def test_eight_landmarks_and_a_scan_need_no_parameters(person):
    points, scan = placed(person, EIGHT, metres=0.008), dressed(person, 0.01)
    alone = fitted(points)
    both = fitted(points, scans={0: scan})
    assert vertex_error_mm(BODY, both.params, person) < 0.5 * vertex_error_mm(BODY, alone.params, person)
    assert vertex_error_mm(BODY, both.params, person) < 15.0


@pytest.mark.parametrize("names", [EIGHT, ("nose", "left_wrist", "right_wrist", "left_ankle", "right_ankle")])
def test_it_turns_and_moves_with_the_landmarks(person, names):
    """With hips and shoulders, and with head, hands and feet alone."""
    turn, move = matrix_from_rotvec(np.array([0.0, 2.6, 0.0])), np.array([0.4, 0.1, -1.0])
    points = placed(person, names)
    there = BODY.forward(fitted(points).params).joints[0]
    moved = BODY.forward(fitted({name: turn @ point + move for name, point in points.items()}).params).joints[0]
    np.testing.assert_allclose(moved, there @ turn.T + move, atol=2e-3)


def test_sides_taken_for_each_other_are_exchanged_back(person):
    points = placed(person, MANY)
    sides = {"left": "right", "right": "left"}
    wrong = {"_".join(sides.get(part, part) for part in name.split("_")): point for name, point in points.items()}
    fit = fitted(wrong)
    assert any("left and right" in words and "exchanged back" in words for words in fit.notes)
    np.testing.assert_allclose(fit.params.body_pose, fitted(points).params.body_pose, atol=1e-6)


def test_one_landmark_in_the_wrong_place_is_let_go_and_named(person):
    points = placed(person, MANY)
    good = joint_error_mm(fitted(points).params, person)
    points["left_elbow"] = points["left_elbow"] + np.array([0.0, 0.0, 0.5])
    fit = fitted(points)
    assert joint_error_mm(fit.params, person) < good + 12.0
    (words,) = fit.notes
    assert "frame 0" in words and "left_elbow" in words and words.count("mm") == 1


def test_landmarks_correct_a_fit(person):
    wrong = BodyParams.from_full_pose(
        person.full_pose, betas=person.betas, expression=person.expression, transl=person.transl + [0.0, 0.0, 0.12]
    )
    fit = fitted(placed(person, MANY), initial=wrong)
    assert joint_error_mm(fit.params, person) < 5.0 < joint_error_mm(wrong, person)
    assert fit.initial_residuals["landmarks_mm"][0] > 100.0


def test_the_error_that_is_expected_is_a_choice(person):
    """Landmarks that are believed less move a fitted hand less."""
    points = placed(person, MANY)
    points["left_wrist"] = points["left_wrist"] + [0.0, 0.0, 0.03]
    observed = Observations((0,), landmarks={0: points}, initial=person)
    wrist = BODY.joint_names.index("left_wrist")
    sure, unsure = (
        BODY.forward(register(BODY, observed, RegisterConfig(landmark_m=metres)).params).joints[0, wrist]
        for metres in (0.003, 0.1)
    )
    before = BODY.forward(person).joints[0, wrist]
    assert np.linalg.norm(unsure - before) < 0.008 < 0.015 < np.linalg.norm(sure - before)


@pytest.mark.parametrize(
    ("names", "words"),
    [(("nose", "left_wrist"), "three points of the trunk"), (("pelvis", "neck", "head", "nose"), "four that lie on")],
)
def test_too_few_landmarks_are_refused(person, names, words):
    points = placed(person, names)
    if len(names) > 2:
        line = {name: points["pelvis"] + [0.0, 0.2 * k, 0.0] for k, name in enumerate(names)}
        points = {**line, "head": line["head"]}
        points["left_ear"] = points.pop("neck")
    with pytest.raises(InputError, match=words):
        fitted(points)


def test_unknown_names_are_left_out_and_said(person):
    points = {**placed(person, MANY), "tail": np.zeros(3)}
    fit = fitted(points)
    assert any("tail" in words for words in fit.notes)
    with pytest.raises(InputError, match="none of these frames that the body has"):
        fitted({"tail": np.zeros(3)})


# --- files ----------------------------------------------------------------------------------------------------------


def test_a_file_is_read_as_it_was_written(person, tmp_path):
    points = placed(person, MANY)
    write_landmarks(tmp_path / "landmarks.json", points)
    read = read_landmarks(tmp_path / "landmarks.json")
    assert list(read) == list(points)
    for name, point in points.items():
        np.testing.assert_allclose(read[name], point, atol=5.1e-5)
    write_landmarks(tmp_path / "landmarks.json", {})
    assert read_landmarks(tmp_path / "landmarks.json") == {}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([1, 2], "an object"),
        ({"nose": [1, 2]}, "nose"),
        ({"nose": [1, "2", 3]}, "nose"),
        ({"nose": [1, None, 3]}, "nose"),
        ({"nose": [1, 2, 1e9]}, "a point in metres"),
        ({"n" * 65: [0, 0, 0]}, "at most 64 letters"),
        ({f"n{k}": [0, 0, 0] for k in range(501)}, "at most 500 names"),
    ],
)
def test_other_files_are_refused(tmp_path, content, words):
    path = tmp_path / "landmarks.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        read_landmarks(path)
