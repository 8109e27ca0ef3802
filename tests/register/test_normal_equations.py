"""The banded solution against a dense one."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.register.normal_equations import Columns, NormalEquations

T, JOINTS, BETAS = 5, 2, 3


def build(rng):
    columns = Columns(np.array([0, 2]), JOINTS + 1, 2, 2, BETAS)
    P = columns.count
    equations = NormalEquations(columns, T)
    dense, target = np.zeros((T * P + BETAS, T * P + BETAS)), np.zeros(T * P + BETAS)
    for frame in range(T):
        rows, residuals = rng.normal(size=(P + 6, P + BETAS)), rng.normal(size=P + 6)
        tells = frame != 3
        equations.add(frame, rows, residuals, shape=tells)
        wide = np.zeros((P + 6, T * P + BETAS))
        wide[:, frame * P : (frame + 1) * P] = rows[:, :P]
        wide[:, T * P :] = rows[:, P:] if tells else 0.0
        dense += wide.T @ wide
        target += wide.T @ residuals
    for first in range(T - 2):
        weight, second = rng.uniform(0.5, 2, P), rng.normal(size=P)
        equations.add_smoothness(first, weight, second)
        for c in range(P):
            row = np.zeros(T * P + BETAS)
            row[[first * P + c, (first + 1) * P + c, (first + 2) * P + c]] = (1, -2, 1)
            dense += weight[c] * np.outer(row, row)
            target += weight[c] * second[c] * row
    return columns, equations, dense, target


@pytest.mark.parametrize("solve_shape", [True, False])
def test_solution_is_the_dense_one(solve_shape):
    columns, equations, dense, target = build(np.random.default_rng(0))
    P, n = columns.count, T * columns.count
    size = len(dense) if solve_shape else n
    exact = -np.linalg.solve(dense[:size, :size], target[:size])
    step = equations.solve(damping=0.0, solve_shape=solve_shape)
    frames = exact[:n].reshape(T, P)
    assert step.rotvecs[:, [0, 2]].reshape(T, -1) == pytest.approx(frames[:, :6], abs=1e-9)
    assert (step.rotvecs[:, 1] == 0).all()
    assert step.transl == pytest.approx(frames[:, 6:9], abs=1e-9)
    assert step.expression == pytest.approx(frames[:, 9:], abs=1e-9)
    assert step.betas == pytest.approx(exact[n:] if solve_shape else np.zeros(BETAS), abs=1e-9)


def test_one_frame_alone():
    columns = Columns(np.array([0]), 1, 0, 0, 1)
    equations, rng = NormalEquations(columns, 1), np.random.default_rng(1)
    rows, residuals = rng.normal(size=(20, 7)), rng.normal(size=20)
    equations.add(0, rows, residuals)
    step = equations.solve(damping=0.0, solve_shape=True)
    exact = -np.linalg.lstsq(rows, residuals, rcond=None)[0]
    assert np.concatenate([step.rotvecs.ravel(), step.transl.ravel(), step.betas]) == pytest.approx(exact)


def test_a_long_step_is_shortened_as_a_whole():
    _, equations, _, _ = build(np.random.default_rng(2))
    step = equations.solve(damping=0.0, solve_shape=True)
    short = step.limited(angle=0.01, length=0.01)
    assert np.linalg.norm(short.rotvecs, axis=2).max() <= 0.01 + 1e-12
    for frame in range(T):
        share = short.transl[frame] / step.transl[frame]
        assert share == pytest.approx(np.full(3, share[0]))
        assert short.rotvecs[frame, [0, 2]] == pytest.approx(share[0] * step.rotvecs[frame, [0, 2]])
