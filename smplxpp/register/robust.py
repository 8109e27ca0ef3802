"""Weights of residuals that may be wrong altogether."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64


def geman_mcclure(
    residual: Float[np.ndarray, " N"], cutoff: Float[np.ndarray, " N"] | float
) -> Float64[np.ndarray, " N"]:
    """Return the weight `1 / (1 + (r / c)^2)^2` of each residual: 1 near 0, a quarter at the cutoff, 1 for c = inf."""
    return 1.0 / (1.0 + (residual / cutoff) ** 2) ** 2
