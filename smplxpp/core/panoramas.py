"""Panoramas that are computed: lights to show a person in where nobody brings one, and to measure relighting in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from smplxpp.core.light import panorama_directions

STUDIO = "two lamps"


def panoramas(height: int = 64) -> dict[str, Float64[np.ndarray, "H W 3"]]:
    """Return linear light by name, twice as wide as high: a low sun, a wood, two lamps of a studio."""
    towards = panorama_directions(height, 2 * height)

    def lamp(place: tuple[float, float, float], color: tuple[float, float, float], sharp: float) -> np.ndarray:
        middle = np.array(place) / np.linalg.norm(place)
        return np.exp(sharp * (towards @ middle - 1.0))[..., None] * np.array(color)

    above = np.maximum(towards[..., 1:2], 0.0)
    return {
        "low sun": 0.12 * np.array([0.5, 0.6, 1.0]) + lamp((1.0, 0.25, 0.35), (9.0, 4.2, 1.4), 8.0),
        "wood": np.array([0.12, 0.1, 0.05]) + np.array([0.5, 0.9, 0.45]) * (above > 0) * (0.3 + 1.5 * above**2),
        STUDIO: 0.05 + lamp((0.7, 0.5, 0.8), (6.0, 6.0, 6.0), 12.0) + lamp((-0.8, 0.3, -0.4), (1.0, 2.0, 5.0), 12.0),
    }
