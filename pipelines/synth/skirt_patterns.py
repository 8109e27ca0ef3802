"""Patterns of the skirt by name: what one could follow it by."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from pipelines.synth.textures import band, mix, weave

RADIUS = 0.21
"""About that of the skirt, metres: lengths around it are angles times this."""
TURN = 2 * np.pi * RADIUS
PLAID = ((150, 34, 44), (28, 60, 66), (236, 204, 120))
LIGHT, DARK = (222, 214, 196), (58, 40, 92)

Pattern = Callable[[Float[np.ndarray, "N 2"]], Float[np.ndarray, "N 3"]]


def _plaid(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Broad dark bands and thin light lines, around and along."""
    around, y = at.T
    period = TURN / 12
    dark = 0.5 * (band(around, period=period, width=0.044) + band(y, period=0.11, width=0.044))
    colors = mix(PLAID[0], PLAID[1], dark)
    line = np.maximum(
        band(around + 0.5 * period, period=period, width=0.009), band(y + 0.055, period=0.11, width=0.009)
    )
    return colors + 0.8 * line[:, None] * (np.array(PLAID[2]) - colors)


def _stripes(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return mix(LIGHT, DARK, band(at[:, 0], period=TURN / 22, width=0.03))


def _hoops(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return mix(LIGHT, DARK, band(at[:, 1], period=0.06, width=0.03))


def _dots(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Dots of 24 mm, 51 mm apart, those of every other row between those of the row before."""
    across, down = TURN / 26, 0.05
    row = np.round(at[:, 1] / down)
    place = at[:, 0] / across + 0.5 * (row % 2)
    away = np.hypot(across * (place - np.round(place)), at[:, 1] - down * row)
    return mix(DARK, LIGHT, np.clip((0.015 - away) / 0.006, 0.0, 1.0))


def _plain(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return mix(LIGHT, DARK, np.full(len(at), 0.5))


PATTERNS: dict[str, Pattern] = {
    "plaid": _plaid,
    "stripes": _stripes,
    "hoops": _hoops,
    "dots": _dots,
    "plain": _plain,
}
"""sRGB, 0 to 255, at metres around and along the skirt. Stripes run down it, hoops around it."""


def around_and_along(offsets: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """Return metres around and along a skirt of points, given from a point on its axis, y."""
    x, y, z = offsets.T
    return np.stack([np.arctan2(x, z) * RADIUS, y], axis=1)


def skirt_colors(points: Float[np.ndarray, "N 3"], centre_z: float, pattern: str = "plaid") -> Float[np.ndarray, "N 3"]:
    """Paint one of `PATTERNS` in wool: threads along and across, of uneven strength. What is plain has no threads."""
    colors = PATTERNS[pattern](around_and_along(points - np.array([0.0, 0.0, centre_z])))
    return colors if pattern == "plain" else colors * (1.0 + 0.09 * weave(points, seed=12))[:, None]
