"""Expansion moves against brute force, and the exact reduction against the whole graph."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smplxpp.core.errors import InputError
from smplxpp.segment.graph_cut import PottsProblem, expand, minimize_potts


def random_problem(rng: np.random.Generator, n: int, labels: int, *, smooth: float = 2.0) -> PottsProblem:
    chosen = [(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.5]
    pairs = np.array(chosen, dtype=np.int64).reshape(-1, 2)
    return PottsProblem.from_costs(rng.random((n, labels)) * 3, pairs, rng.random(len(pairs)) * smooth)


def grid_problem(rng: np.random.Generator, side: int, labels: int) -> PottsProblem:
    index = np.arange(side * side).reshape(side, side)
    pairs = np.concatenate(
        [np.stack([index[:, :-1], index[:, 1:]], 2), np.stack([index[:-1].T, index[1:].T], 2)]
    ).reshape(-1, 2)
    truth = (index // (side * side // labels + 1)).ravel()
    unary = np.where(np.arange(labels) == truth[:, None], 0.0, 1.75) + rng.random((side * side, labels)) * 3.5
    return PottsProblem.from_costs(unary, pairs, 0.2 + rng.random(len(pairs)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 8), st.integers(2, 4))
def test_expansion_is_the_best_move(seed: int, n: int, label_count: int):
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, n, label_count)
    labels = rng.integers(0, label_count, n)
    for alpha in range(label_count):
        moves = itertools.product([False, True], repeat=n)
        best = min(problem.energy(np.where(x, alpha, labels)) for x in moves)
        for reduce in (True, False):
            assert problem.energy(expand(problem, labels, alpha, reduce=reduce)) == best


def test_two_labels_reach_the_global_minimum():
    rng = np.random.default_rng(1)
    for _ in range(20):
        problem = random_problem(rng, 8, 2)
        best = min(problem.energy(np.array(x)) for x in itertools.product([0, 1], repeat=8))
        assert minimize_potts(problem)[1] == best


def test_reduced_expansion_has_the_energy_of_the_whole_graph():
    rng = np.random.default_rng(2)
    problem = grid_problem(rng, 40, 5)
    labels = problem.unary.argmin(axis=1)
    for alpha in range(5):
        whole = problem.energy(expand(problem, labels, alpha, reduce=False))
        assert problem.energy(expand(problem, labels, alpha)) == whole


def test_converged_labels_admit_no_better_move():
    problem = grid_problem(np.random.default_rng(3), 40, 5)
    labels, energy = minimize_potts(problem)
    assert energy == problem.energy(labels) < problem.energy(problem.unary.argmin(axis=1))
    for alpha in range(5):
        assert problem.energy(expand(problem, labels, alpha, reduce=False)) == energy


def test_bad_costs_are_refused():
    pairs = np.array([[0, 1]])
    with pytest.raises(InputError, match="negative"):
        PottsProblem.from_costs(np.zeros((2, 2)), pairs, np.array([-1.0]))
    with pytest.raises(InputError, match="at most"):
        PottsProblem.from_costs(np.full((2, 2), 1e9), pairs, np.ones(1))
