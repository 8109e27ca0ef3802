"""Smooth random fields and smooth steps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def smooth_noise(
    points: Float[np.ndarray, "N 3"], *, scale: tuple[float, float, float], seed: int, waves: int = 24
) -> Float[np.ndarray, " N"]:
    """Return a smooth random field of about unit size: a sum of seeded plane waves of the given scale (metres) an axis.

    Computed in the points' own precision.
    """
    rng = np.random.default_rng(seed)
    frequency = (rng.normal(size=(waves, 3)) / np.asarray(scale)).astype(points.dtype)
    phase = rng.uniform(0, 2 * np.pi, waves).astype(points.dtype)
    return np.sin(points @ frequency.T + phase).sum(axis=1) / points.dtype.type(np.sqrt(waves / 2))


def ramp(x: Float[np.ndarray, " N"], start: float, end: float) -> Float[np.ndarray, " N"]:
    """Step smoothly from 0 at `start` to 1 at `end` (either order)."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return t * t * (3 - 2 * t)
