"""The banded step of all frames against a dense one, and what trust and smoothness do."""

from __future__ import annotations

import numpy as np

from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.solve import Normal, changes, smoothness, solve, with_prior
from avatar.training.refinement.variables import Variables
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register import BodyState
from tests.dolls.gesturing import gestures, template

CONFIG = RefineConfig(jaw=False, expression=False)
VARIABLES = Variables.of_body(55, 0, CONFIG)
P = len(VARIABLES)


def still(frames: int) -> BodyState:
    return BodyState.of_params(template().body, gestures().select([0] * frames))


def test_the_banded_step_is_the_dense_one():
    frames = (3, 4, 5, 6, 9)  # no neighbours around 9
    F, random = len(frames), np.random.default_rng(0)
    state = still(F)
    state = VARIABLES.stepped(state, 0.02 * random.normal(size=(F, P)))
    factor = random.normal(size=(F, P, P + 5))
    normal = Normal(random.normal(size=(F, P)), factor @ factor.swapaxes(1, 2))
    smooth = smoothness(VARIABLES, state, frames, CONFIG, None)
    assert smooth.triple.tolist() == [False, True, True, False, False]
    damping = np.full(F, 0.1)
    dense, right = np.zeros((F * P, F * P)), normal.gradient.copy().ravel()
    for t in range(F):
        block = slice(t * P, (t + 1) * P)
        dense[block, block] += normal.curvature[t] + 0.1 * np.diag(np.diag(normal.curvature[t]))
    for t in np.flatnonzero(smooth.triple):
        second = np.zeros((P, F * P))
        for offset, share in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            second[:, (t + offset) * P : (t + offset + 1) * P] = share * np.eye(P)
        dense += second.T @ np.diag(smooth.weight[t]) @ second
        right += second.T @ (smooth.weight[t] * smooth.acceleration[t])
    expected = -np.linalg.solve(dense, right).reshape(F, P)
    np.testing.assert_allclose(solve(normal, smooth, damping), expected, rtol=1e-6, atol=1e-9)


def test_without_photographs_a_rigid_uneven_motion_becomes_even_and_an_even_one_stays():
    frames = tuple(range(7))
    nothing = Normal(np.zeros((7, P)), 1e-9 * np.tile(np.eye(P), (7, 1, 1)))
    turning = matrix_from_rotvec(np.linspace(0.0, 0.6, 7)[:, None] * [0.0, 1.0, 0.0])
    even = still(7)
    rotations = even.rotations.copy()
    rotations[:, 0] = turning @ rotations[:, 0]
    even = BodyState(rotations, even.transl + np.arange(7)[:, None] * [0.01, 0.0, 0.0], even.betas, even.expression)
    smooth = smoothness(VARIABLES, even, frames, CONFIG, 20.0)
    assert np.abs(solve(nothing, smooth, np.zeros(7))).max() < 1e-9
    uneven = BodyState(even.rotations, even.transl.copy(), even.betas, even.expression)
    uneven.transl[3, 1] += 0.002
    smooth = smoothness(VARIABLES, uneven, frames, CONFIG, 20.0)
    step = solve(nothing, smooth, np.zeros(7))
    after = VARIABLES.stepped(uneven, step)
    assert np.abs(np.diff(after.transl, 2, axis=0)).max() < 0.1 * np.abs(np.diff(uneven.transl, 2, axis=0)).max()


def test_fast_motion_counts_little():
    frames, slow = (0, 1, 2), still(3)
    weights = []
    for jump in (0.001, 0.2):
        moved = BodyState(slow.rotations, slow.transl.copy(), slow.betas, slow.expression)
        moved.transl[1, 0] += jump
        weights.append(smoothness(VARIABLES, moved, frames, CONFIG, 20.0).weight[1, VARIABLES.transl][0])
    assert weights[1] < 0.01 * weights[0]


def test_trust_pulls_back_to_the_start():
    start = still(2)
    state = VARIABLES.stepped(start, np.full((2, P), 0.01))
    change = changes(VARIABLES, start, state)
    np.testing.assert_allclose(change, 0.01, atol=1e-9)
    normal = with_prior(Normal(np.zeros((2, P)), np.zeros((2, P, P))), change, VARIABLES.sigma)
    step = solve(normal, smoothness(VARIABLES, state, (0, 1), CONFIG, None), np.zeros(2))
    back = changes(VARIABLES, start, VARIABLES.stepped(state, step))
    assert np.abs(back).max() < 1e-4
