"""Ranges, ordinary poses, noise of a fit, slow change."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.register import RegisterConfig
from smplxpp.register.kinematics import BodyState
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.priors import Anatomy, Priors, left_jacobian_inverse
from smplxpp.register.start import white_noise
from tests.register.people import disturbed, moving

BODY = load_body()
COLUMNS = Columns(np.arange(55), 55, 0, BODY.num_expressions, BODY.num_betas)


def test_ranges_are_mirrored():
    anatomy, names = Anatomy.of(55), list(BODY.joint_names)
    for left in [name for name in names if name.startswith("left_")]:
        a, b = names.index(left), names.index(left.replace("left_", "right_"))
        mirror = np.array([1.0, -1.0, -1.0])
        ends = np.sort(np.stack([anatomy.lowest[a] * mirror, anatomy.highest[a] * mirror]), axis=0)
        assert np.array([anatomy.lowest[b], anatomy.highest[b]]) == pytest.approx(ends)
    assert (anatomy.lowest < 0).all() and (anatomy.highest > 0).all()


def test_derivative_of_the_logarithm():
    rng, step = np.random.default_rng(0), 1e-6
    for vector in (rng.normal(0, 1, 3), rng.normal(0, 1e-5, 3)):
        inverse = left_jacobian_inverse(vector)
        for axis in range(3):
            turn = np.zeros(3)
            turn[axis] = step
            ahead, behind = (
                rotvec_from_matrix(matrix_from_rotvec(sign * turn) @ matrix_from_rotvec(vector)) for sign in (1, -1)
            )
            assert (ahead - behind) / (2 * step) == pytest.approx(inverse[:, axis], abs=1e-6)


def test_a_bent_back_knee_is_straightened():
    rotations = np.tile(np.eye(3), (1, 55, 1, 1))
    knee = BODY.joint_names.index("left_knee")
    rotations[0, knee] = matrix_from_rotvec(np.array([np.radians(-40.0), 0.0, 0.0]))
    state = BodyState(rotations, np.zeros((1, 3)), np.zeros(BODY.num_betas), np.zeros((1, BODY.num_expressions)))
    config = RegisterConfig(pose_prior=1e-6)
    equations = NormalEquations(COLUMNS, 1)
    Priors(COLUMNS, np.array([0]), Anatomy.of(55), config).add(equations, state, shape=False)
    turns = equations.solve(damping=1e-6, solve_shape=False).rotvecs
    bent = matrix_from_rotvec(turns) @ rotations
    angle = np.degrees(rotvec_from_matrix(bent[0, knee])[0])
    assert -9.0 < angle < -7.0  # the bound, not zero


def test_noise_of_a_fit_is_measured():
    smooth = moving(BODY, 40)
    noisy = disturbed(smooth, degrees=1.5, metres=0.006, betas=0.0)
    frames = np.arange(40)
    pose, transl = white_noise(BodyState.of_params(BODY, noisy), frames)
    assert np.degrees(pose) == pytest.approx(1.5, rel=0.15)
    assert transl == pytest.approx(0.006, rel=0.3)
    assert white_noise(BodyState.of_params(BODY, noisy.select(slice(0, 5))), frames[:5]) is None


def test_steady_motion_costs_nothing():
    """Constant speed has no acceleration: the smoothness pulls nowhere."""
    speed = np.random.default_rng(1).normal(0, 0.02, (55, 3))
    rotations = np.stack([matrix_from_rotvec(k * speed) for k in range(6)])
    state = BodyState(
        rotations, np.arange(6)[:, None] * np.ones(3), np.zeros(BODY.num_betas), np.zeros((6, BODY.num_expressions))
    )
    equations = NormalEquations(COLUMNS, 6)
    priors = Priors(COLUMNS, np.arange(6), Anatomy.of(55), RegisterConfig(), fps=20.0)
    priors._add_smoothness(equations, state)
    assert np.abs(equations.gradient).max() < 1e-6
    assert (equations.smooth[0] > 0).any()


def test_frames_far_apart_say_nothing_of_each_other():
    state = BodyState.of_params(BODY, moving(BODY, 4))
    for frames in ([0, 20, 40, 60], [0, 1, 5, 6]):
        equations = NormalEquations(COLUMNS, 4)
        priors = Priors(COLUMNS, np.array(frames), Anatomy.of(55), RegisterConfig(), fps=20.0)
        priors._add_smoothness(equations, state)
        assert not equations.smooth.any()
