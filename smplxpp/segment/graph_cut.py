"""Minimise a Potts energy on a graph by alpha-expansion with exact reductions.

E(L) = sum_i U[i, L_i] + sum_(p,q) w_pq [L_p != L_q]        (Boykov, Veksler and Zabih 2001)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, Integer, Num
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from smplxpp.core.errors import InputError

COST_SCALE = 1000
"""Integer units of one unit of cost. Costs are integers, so that flows are exact and results equal on all machines."""


@dataclass(frozen=True, eq=False)
class PottsProblem:
    """A Potts energy with integer costs.

    Attributes:
        unary: (n, L) int64 cost of each label at each node.
        pairs: (E, 2) neighbouring nodes, each pair once.
        weights: (E,) int64 cost of two different labels at a pair, none negative.
    """

    unary: Int64[np.ndarray, "n L"]
    pairs: Int64[np.ndarray, "E 2"]
    weights: Int64[np.ndarray, " E"]

    @staticmethod
    def from_costs(
        unary: Num[np.ndarray, "n L"], pairs: Integer[np.ndarray, "E 2"], weights: Num[np.ndarray, " E"]
    ) -> PottsProblem:
        """Round real costs to thousandths and build the problem.

        Raises:
            InputError: NaN, negative weights, or costs too large for the solver's 32-bit capacities.
        """
        unary, weights = np.asarray(unary, dtype=np.float64), np.asarray(weights, dtype=np.float64)
        if not (np.isfinite(unary).all() and np.isfinite(weights).all()) or (weights < 0).any():
            raise InputError("graph-cut costs", expected="finite, weights not negative", received="NaN or negative")
        largest = max(np.abs(unary).max(initial=0), weights.max(initial=0))
        if largest > 1e5:
            raise InputError("graph-cut costs", expected="at most 1e5", received=f"{largest:.3g}")
        return PottsProblem(
            np.rint(unary * COST_SCALE).astype(np.int64),
            np.asarray(pairs, dtype=np.int64).reshape(-1, 2),
            np.rint(weights * COST_SCALE).astype(np.int64),
        )

    def energy(self, labels: Integer[np.ndarray, " n"]) -> int:
        """Return the energy E(L) of a labelling, in thousandths."""
        p, q = self.pairs.T
        return int(self.unary[np.arange(len(labels)), labels].sum() + self.weights[labels[p] != labels[q]].sum())


def minimize_potts(
    problem: PottsProblem, *, labels: Integer[np.ndarray, " n"] | None = None, reduce: bool = True
) -> tuple[Int64[np.ndarray, " n"], int]:
    """Minimise the energy by alpha-expansion, until no single label can grow to a lower energy.

    Args:
        problem: the energy.
        labels: labels to start from; None starts from the cheapest label of each node.
        reduce: leave nodes that provably keep their label (`_may_switch`) out of each cut; the energy of every
            expansion is the same without.

    Returns:
        (n,) labels and their energy in thousandths.
    """
    count, label_count = problem.unary.shape
    current = problem.unary.argmin(axis=1) if labels is None else np.array(labels, dtype=np.int64)
    energy = problem.energy(current)
    # A label that failed to grow is tried again only after another one has grown.
    stale, alpha = 0, 0
    while count and stale < label_count:
        proposal = expand(problem, current, alpha, reduce=reduce)
        proposed = problem.energy(proposal)
        if proposed < energy:
            current, energy, stale = proposal, proposed, 0
        stale += 1
        alpha = (alpha + 1) % label_count
    return current, energy


def expand(
    problem: PottsProblem, labels: Integer[np.ndarray, " n"], alpha: int, *, reduce: bool = True
) -> Int64[np.ndarray, " n"]:
    """Return the labelling of least energy among those where each node keeps its label or takes `alpha`.

    With x = 1 for "takes alpha", an edge costs A, B, C, 0 for (x_p, x_q) = 00, 01, 10, 11. All costs doubled, that is
    (B + C - A) [x_p != x_q] + (C - B - A) x_p + (B - C - A) x_q + constant: a cut with symmetric capacities.
    """
    # Costs of the binary problem.
    p, q = problem.pairs.T
    a = problem.weights * (labels[p] != labels[q])
    b = problem.weights * (labels[p] != alpha)
    c = problem.weights * (labels[q] != alpha)
    cost = 2 * (problem.unary[:, alpha] - problem.unary[np.arange(len(labels)), labels])
    linear = (c - b - a, b - c - a)
    for nodes, values in zip((p, q), linear, strict=True):
        # Exact: float64 sums of integers far below 2^53.
        cost += np.bincount(nodes, values, minlength=len(labels)).astype(np.int64)
    capacity = b + c - a
    linked = capacity > 0
    p, q, capacity = p[linked], q[linked], capacity[linked]
    active = _may_switch(cost, p, q, capacity) if reduce else np.ones(len(labels), dtype=bool)
    out = labels.copy()
    if active.any() and (cost < 0).any():
        out[_cut(cost, p, q, capacity, active)] = alpha
    return out


def _may_switch(cost: np.ndarray, p: np.ndarray, q: np.ndarray, capacity: np.ndarray) -> np.ndarray:
    """Return a set of nodes outside which none takes alpha in some minimal cut.

    It starts as the nodes that gain by switching alone (cost < 0) and takes in, until nothing changes, every node i
    with cost_i < sum of the capacities to nodes inside. Then for any set S of nodes outside, switching S back to its
    labels changes the cut by at most -sum_S cost + capacity(S, inside) <= 0, so S need not switch.
    """
    # Adjacency in compressed rows, then a breadth-first growth of the set.
    n = len(cost)
    rows = np.concatenate([p, q])
    order = np.argsort(rows, kind="stable")
    neighbor = np.concatenate([q, p])[order]
    weight = np.concatenate([capacity, capacity])[order]
    start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    active = cost < 0
    margin = cost.copy()
    front = np.flatnonzero(active)
    while len(front):
        length = start[front + 1] - start[front]
        offset = np.repeat(start[front] - np.concatenate([[0], np.cumsum(length)[:-1]]), length)
        slots = offset + np.arange(int(length.sum()))
        np.subtract.at(margin, neighbor[slots], weight[slots])
        touched = np.unique(neighbor[slots])
        front = touched[~active[touched] & (margin[touched] < 0)]
        active[front] = True
    return active


def _cut(cost: np.ndarray, p: np.ndarray, q: np.ndarray, capacity: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Return the indices of the nodes that take alpha: those on the source's side of the minimum cut."""
    nodes = np.flatnonzero(active)
    place = np.full(len(cost), -1)
    place[nodes] = np.arange(len(nodes))
    own = cost.copy()
    # An edge to a node that keeps its label is a plain cost of switching.
    for here, there in ((p, q), (q, p)):
        leaving = active[here] & ~active[there]
        own += np.bincount(here[leaving], capacity[leaving], minlength=len(cost)).astype(np.int64)
    # The flow network: the source feeds nodes that gain by switching, nodes that lose drain into the sink.
    inner = active[p] & active[q]
    i, j, c = place[p[inner]], place[q[inner]], capacity[inner]
    own = own[nodes]
    n = len(nodes)
    source, sink = n, n + 1
    gain, loss = np.flatnonzero(own < 0), np.flatnonzero(own > 0)
    rows = np.concatenate([i, j, np.full(len(gain), source), loss])
    cols = np.concatenate([j, i, gain, np.full(len(loss), sink)])
    caps = np.concatenate([c, c, -own[gain], own[loss]]).astype(np.int32)
    graph = csr_matrix((caps, (rows, cols)), shape=(n + 2, n + 2))
    # After the maximum flow, the nodes that the residual graph reaches from the source are on its side of the cut.
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    return nodes[reached[reached < n]]
