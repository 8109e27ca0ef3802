"""The cost of every label at every face: its place on the body, its colour among the label's, its distance.

The colours of a label are those of the faces that are surely its own; what is sure changes as the colours are known
(expectation maximisation, a few rounds).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_matrix

from smplxpp.core.labels import HAIR, LABELS, SKIN
from smplxpp.segment.by_body_colors import Palette


@dataclass(frozen=True, eq=False)
class Blend:
    """Means over the faces around each, that stop at edges of colour.

    Attributes:
        matrix: (M, M) rows sum to 1. steps: how often it is applied.
    """

    matrix: csr_matrix
    steps: int

    @staticmethod
    def of(pairs: Int64[np.ndarray, "P 2"], alike: Float64[np.ndarray, " P"], count: int, *, steps: int) -> Blend:
        """Args: pairs: faces at an edge. alike: 0 to 1, how much crosses it. count: of faces."""
        here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
        own = np.arange(count)
        values = np.concatenate([np.tile(alike, 2), np.full(count, 0.2)])
        matrix = csr_matrix((values, (np.concatenate([here, own]), np.concatenate([there, own]))), shape=(count, count))
        share = 1.0 / np.asarray(matrix.sum(axis=1)).ravel()
        matrix.data *= np.repeat(share, np.diff(matrix.indptr))
        return Blend(matrix, steps)

    def __call__(self, values: Float64[np.ndarray, "M L"]) -> Float64[np.ndarray, "M L"]:
        for _ in range(self.steps):
            values = self.matrix @ values
        return values


def label_costs(
    prior: Float64[np.ndarray, "M L"],
    palette: Palette | None,
    skin_like: Float64[np.ndarray, " M"],
    *,
    area: Float64[np.ndarray, " M"],
    far: Float64[np.ndarray, " M"],
    blend: Blend,
    bald: bool,
    rounds: int,
    cap: float,
) -> Float64[np.ndarray, "M L"]:
    """-log P(label | place, colours around, distance) but for a constant a face, nats.

    Args:
        prior: of the place. palette: None without colours. skin_like: probability that the colour is skin's.
        far: log ratio of the distance to the body for cloth or hair against skin. cap: most that colour may cost.
    """
    base = -np.log(prior)
    base[:, SKIN.id] += far
    if palette is None:
        return blend(base)
    posterior = prior.copy()
    posterior[:, SKIN.id] *= skin_like
    discount = np.ones((palette.size, len(LABELS)))
    cost = base
    for _ in range(rounds):
        sure = posterior * np.maximum(posterior - 0.5, 0.0) * discount[palette.index] * area[:, None]
        sure[:, SKIN.id] *= skin_like
        if not bald:
            sure[:, HAIR.id] *= 1.0 - 0.9 * skin_like
        table = _color_shares(palette, sure, area)
        # A colour that is another label's says nothing of what this one has: a braid is no part of the shirt.
        discount = table / table.max(axis=1, keepdims=True)
        of_color = -np.log(table)
        of_color = np.minimum(of_color - of_color.min(axis=1, keepdims=True), cap)
        cost = blend(of_color[palette.index]) + base
        posterior = np.exp(cost.min(axis=1, keepdims=True) - cost)
        posterior /= posterior.sum(axis=1, keepdims=True)
    return cost


def _color_shares(palette: Palette, sure: np.ndarray, area: np.ndarray) -> Float64[np.ndarray, "K L"]:
    """P(colour | label); tiny for labels that no face surely has."""
    worn = sure.sum(axis=0) > 1e-4 * area.sum()
    shares = [
        palette.histogram(sure[:, k]) if worn[k] else np.full(palette.size, 1e-3 / palette.size)
        for k in range(len(LABELS))
    ]
    return np.stack(shares, axis=1)
