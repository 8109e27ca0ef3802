"""Smooth labels along a surface: costs of label changes across edges, a graph cut, and removal of small patches.

The cut minimises a Potts energy by alpha-expansion with exact reductions (Boykov, Veksler and Zabih 2001):

    E(L) = sum_i U[i, L_i] + sum_(p,q) w_pq [L_p != L_q]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Integer, Num
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from smplxpp.core import LABELS, SKIN, InputError, Labels, TriangleMesh
from smplxpp.core.colors import linear_from_srgb, oklab_from_linear
from smplxpp.core.topology import component_labels

COLOR_STEP = np.array([0.055, 0.022, 0.022])
"""Scale of OKLab differences (L, a, b). Light and noise change lightness most, so that it weighs least."""


@dataclass(frozen=True)
class SmoothingConfig:
    """Costs of label changes, and bounds below which a patch is too small.

    Attributes:
        smoothness: factor of the pairwise cost.
        floor: lower bound of the pairwise cost at any edge.
        eta_convex: how much a convex fold lowers the cost of a label change.
        eta_concave: the same for a concave fold.
        fold: scale of 1 - cos(dihedral angle) in the pairwise cost.
        least_contrast: factor of the cost across the strongest edges of colour, if colours are given.
        speck_area: area fraction of the surface below which a patch of skin is relabelled.
        island_area: the same for patches of garments, hair and shoes. Parsers leave such fragments near label borders
            (a bit of skirt on the fingers); nothing worn is smaller than 57 of 19,000 square centimetres.
        uncertain_area: the same for patches of any label with a mean confidence below `uncertain`.
        uncertain: mean confidence below which a patch is uncertain.
    """

    smoothness: float = 1.2
    floor: float = 0.05
    eta_convex: float = 0.15
    eta_concave: float = 1.0
    fold: float = 0.1
    least_contrast: float = 0.1
    speck_area: float = 1e-4
    island_area: float = 3e-3
    uncertain_area: float = 5e-3
    uncertain: float = 0.7


def face_colors(mesh: TriangleMesh, colors: Num[np.ndarray, "N C"]) -> Float64[np.ndarray, "M 3"]:
    """Return the mean OKLab colour of each face's corners.

    Args:
        mesh: the mesh.
        colors: sRGB of the vertices, bytes or 0..1, with or without opacity.

    Raises:
        InputError: another number of vertices, or values out of range.
    """
    colors = np.asarray(colors)
    if colors.ndim != 2 or len(colors) != mesh.vertex_count or colors.shape[1] not in (3, 4):
        raise InputError("vertex colours", expected=f"shape ({mesh.vertex_count}, 3)", received=f"shape {colors.shape}")
    colors = colors[:, :3]
    fits = colors.dtype == np.uint8
    if colors.dtype.kind == "f" and colors.size:
        fits = bool(np.isfinite(colors).all() and colors.min() >= 0 and colors.max() <= 1)
    if not fits:
        raise InputError(
            "vertex colours",
            expected="bytes, or numbers from 0 to 1",
            received=f"{colors.dtype}, or values out of range",
        )
    return oklab_from_linear(linear_from_srgb(colors))[mesh.faces].mean(axis=1)


def likeness(lab: Float64[np.ndarray, "M 3"], pairs: Int64[np.ndarray, "P 2"]) -> Float64[np.ndarray, " P"]:
    """Return the similarity of neighbours' colours: 1 for equal colours, near 0 for far more than the mean difference.

    `exp(-d^2 / (2 mean d^2))` (Rother et al., GrabCut, 2004), d the difference in steps of `COLOR_STEP`.
    """
    squared = (((lab[pairs[:, 0]] - lab[pairs[:, 1]]) / COLOR_STEP) ** 2).sum(axis=1)
    mean = float(squared.mean()) if len(squared) else 0.0
    return np.exp(-squared / (2.0 * max(mean, 1e-9)))


def edge_weights(
    mesh: TriangleMesh,
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    config: SmoothingConfig,
    *,
    lab: Float64[np.ndarray, "M 3"] | None = None,
) -> Float64[np.ndarray, " P"]:
    """Return the cost of a label change across each edge; it is low at folds and across edges of colour.

    Args:
        mesh: the mesh.
        pairs: the two faces of each edge (`face_adjacency`).
        ends: the two vertices of each edge.
        config: weights.
        lab: colours of the faces (`face_colors`).
    """
    # w = smoothness (length / mean) exp(-eta (1 - cos dihedral) / fold) + floor, times the contrast of colours.
    length = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    normal = mesh.face_normals
    n0, n1 = normal[pairs[:, 0]], normal[pairs[:, 1]]
    deficit = 1.0 - np.einsum("ij,ij->i", n0, n1)
    middle = mesh.triangles.mean(axis=1)
    # Concave: the neighbour lies on the side that the normal points to.
    concave = np.einsum("ij,ij->i", middle[pairs[:, 1]] - middle[pairs[:, 0]], n0 - n1) > 0
    eta = np.where(concave, config.eta_concave, config.eta_convex)
    mean = length.mean() if len(length) else 1.0
    weights = config.smoothness * length / mean * np.exp(-eta * deficit / config.fold) + config.floor
    if lab is None:
        return weights
    return weights * (config.least_contrast + (1.0 - config.least_contrast) * likeness(lab, pairs))


def absorb_islands(
    mesh: TriangleMesh,
    face_labels: Int64[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    config: SmoothingConfig,
    *,
    labels: Labels = LABELS,
) -> Int64[np.ndarray, " M"]:
    """Relabel patches that are too small to the label with which they share the longest border.

    Only patches that are large enough pass on their label; a small patch that touches none of them keeps its own. A
    user's own labels of small things (`Labels.small`) have the bound of skin, because glasses are no fragment.
    """
    # Patches are connected faces of one label; the least area depends on the label and the mean confidence.
    same = face_labels[pairs[:, 0]] == face_labels[pairs[:, 1]]
    patch = component_labels(pairs[same], len(face_labels))
    area = np.bincount(patch, mesh.face_areas)
    label_of_patch = np.empty(len(area), dtype=np.int64)
    label_of_patch[patch] = face_labels
    uncertain = np.bincount(patch, mesh.face_areas * confidence) < config.uncertain * area
    things = labels.small[label_of_patch]
    least = np.where(things | (label_of_patch == SKIN.id), config.speck_area, config.island_area)
    least = np.where(uncertain & ~things, np.maximum(least, config.uncertain_area), least)
    small = area < least * area.sum()
    if not small.any():
        return face_labels
    # Lengths of the borders between each small patch and the labels of large patches around it.
    crossing = pairs[~same]
    length = np.linalg.norm(np.diff(mesh.vertices[ends[~same]], axis=1)[:, 0], axis=1)
    here = np.concatenate([patch[crossing[:, 0]], patch[crossing[:, 1]]])
    there = np.concatenate([patch[crossing[:, 1]], patch[crossing[:, 0]]])
    usable = small[here] & ~small[there]
    border = np.zeros((len(area), len(labels)))
    np.add.at(border, (here[usable], label_of_patch[there[usable]]), np.concatenate([length, length])[usable])
    absorbed = border.any(axis=1)
    label_of_patch[absorbed] = border[absorbed].argmax(axis=1)
    return label_of_patch[patch]


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
