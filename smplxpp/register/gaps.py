"""How far what a body wears stands off from it, learned while the body is fitted.

Clothes say where a body is as far as they keep their distance. For every place on the body the distances that were seen
(over views and frames) have a median, the gap, and a spread about it: a tight shirt holds the body to millimetres, the
hem of a skirt to nothing. So a surface of clothes is never pulled onto the body, and a loose one does not pull at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64


@dataclass(frozen=True, eq=False)
class Gaps:
    """Gaps of K places.

    Attributes:
        median: metres. spread: robust standard deviation, inf where too little was seen.
    """

    median: Float64[np.ndarray, " K"]
    spread: Float64[np.ndarray, " K"]

    @staticmethod
    def unknown(count: int) -> Gaps:
        """Nothing seen yet."""
        return Gaps(np.zeros(count), np.full(count, np.inf))

    @staticmethod
    def learned(
        place: Int64[np.ndarray, " N"], distance: Float64[np.ndarray, " N"], count: int, *, least: int, tight: float
    ) -> Gaps:
        """Of distances seen at places.

        Args:
            count: K. least: a place seen less often is not known. tight: least spread, metres.
        """
        order = np.lexsort((distance, place))
        place, distance = place[order], distance[order]
        start = np.searchsorted(place, np.arange(count))
        number = np.searchsorted(place, np.arange(count), side="right") - start
        known = number >= least
        median, spread = np.zeros(count), np.full(count, np.inf)
        low, high = start + (number * 0.159).astype(int), start + (number * 0.841).astype(int)
        middle = np.minimum(start + number // 2, len(distance) - 1)
        if known.any():
            median[known] = distance[middle[known]]
            last = len(distance) - 1
            wide = distance[np.minimum(high[known], last)] - distance[np.minimum(low[known], last)]
            spread[known] = np.hypot(0.5 * wide, tight)
        # What covers a body is not inside it.
        return Gaps(np.maximum(median, 0.0), spread)
