"""Points of a posed body and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core.params import BodyParams
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics

BODY = load_body()
STEP = 1e-6


@pytest.fixture(scope="module")
def params():
    rng = np.random.default_rng(0)
    return BodyParams.from_full_pose(
        rng.normal(0, 0.3, (2, 55, 3)),
        betas=rng.normal(0, 1, (1, BODY.num_betas)),
        expression=rng.uniform(0, 0.5, (2, BODY.num_expressions)),
        transl=rng.normal(0, 1, (2, 3)),
    )


@pytest.fixture(scope="module")
def scene(params):
    kinematics, state = Kinematics(BODY), BodyState.of_params(BODY, params)
    index = np.random.default_rng(1).permutation(BODY.vertex_count)[:60]
    points = BodyPoints.joined([BodyPoints.of_vertices(BODY, index), BodyPoints.of_joints(BODY, np.arange(55))])
    return kinematics, state, points, index


def test_points_are_the_body_models(scene, params):
    kinematics, state, points, index = scene
    posed = BODY.forward(params)
    for row in range(2):
        posture = kinematics.posture(state, row)
        here = kinematics.points(points, posture)
        # Joints do not follow expressions here; those of the open body hardly do (the regressor's rounding).
        assert np.abs(here[:60] - posed.vertices[row, index]).max() < 1e-7
        assert np.abs(here[60:] - posed.joints[row]).max() < 1e-7
        assert np.abs(here - kinematics.motion(points, posture).points).max() < 1e-12


def test_state_and_parameters_are_one(scene, params):
    _, state, _, _ = scene
    back = state.to_params(BODY, fps=20.0)
    assert back.fps == 20.0
    assert np.abs(BODY.forward(back).vertices - BODY.forward(params).vertices).max() < 1e-9


def test_derivatives_are_differences(scene):
    kinematics, state, points, _ = scene
    motion = kinematics.motion(points, kinematics.posture(state, 1))
    zeros = {
        "rotvecs": np.zeros((2, 55, 3)),
        "transl": np.zeros((2, 3)),
        "betas": np.zeros(BODY.num_betas),
        "expression": np.zeros((2, BODY.num_expressions)),
    }

    def moved(name, where, by):
        step = {key: value.copy() for key, value in zeros.items()}
        step[name][where] = by
        return kinematics.points(points, kinematics.posture(kinematics.updated(state, **step), 1))

    def difference(name, where):
        return (moved(name, where, STEP) - moved(name, where, -STEP)) / (2 * STEP)

    for joint in (0, 3, 12, 16, 20, 40):
        for axis in range(3):
            assert np.abs(difference("rotvecs", (1, joint, axis)) - motion.pose[:, :, joint, axis]).max() < 1e-8
    for k in (0, 7, 19):
        assert np.abs(difference("betas", k) - motion.shape[:, :, k]).max() < 1e-8
        assert np.abs(difference("expression", (1, k)) - motion.expression[:, :, k]).max() < 1e-8


def test_points_between_corners_follow_them(scene):
    kinematics, state, _, _ = scene
    near = BODY.faces[:40]
    corners = BodyPoints.of_vertices(BODY, np.arange(BODY.vertex_count))
    weight = np.random.default_rng(2).dirichlet(np.ones(3), 40)
    posture = kinematics.posture(state, 0)
    there = kinematics.points(corners.mixed(near, weight), posture)
    exact = np.einsum("mc,mcx->mx", weight, kinematics.points(corners, posture)[near])
    assert np.abs(there - exact).max() < 2e-4
