"""Procedural patterns: smooth noise and steps, bands and weave, and the patterns of the skirt by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Color = tuple[int, int, int]
"""sRGB, 0 to 255."""

SKIRT_RADIUS = 0.21
"""About the radius of the skirt, metres: lengths around it are angles times this."""
SKIRT_GIRTH = 2 * np.pi * SKIRT_RADIUS


def smooth_noise(
    points: Float[np.ndarray, "N 3"], *, scale: tuple[float, float, float], seed: int, waves: int = 24
) -> Float[np.ndarray, " N"]:
    """Return a smooth random field of about unit standard deviation, in the precision of the points.

    It is a sum of seeded plane waves: `sum over k of sin(f_k . x + phase_k) / sqrt(waves / 2)`.

    Args:
        points: metres.
        scale: wavelength scale along each axis, metres; frequencies are normal deviates over it.
        seed: seed of frequencies and phases.
        waves: number of waves.
    """
    rng = np.random.default_rng(seed)
    frequency = (rng.normal(size=(waves, 3)) / np.asarray(scale)).astype(points.dtype)
    phase = rng.uniform(0, 2 * np.pi, waves).astype(points.dtype)
    return np.sin(points @ frequency.T + phase).sum(axis=1) / points.dtype.type(np.sqrt(waves / 2))


def ramp(x: Float[np.ndarray, " N"], start: float, end: float) -> Float[np.ndarray, " N"]:
    """Return the cubic smooth step from 0 at `start` to 1 at `end`, in either order."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def mix(a: Color, b: Color, t: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
    """Return the linear mix of two colours: `a` at t = 0, `b` at t = 1."""
    t = np.asarray(t, dtype=float)[:, None]
    return (1 - t) * np.asarray(a, dtype=float) + t * np.asarray(b, dtype=float)


def band(x: Float[np.ndarray, " N"], *, period: float, width: float, edge: float = 0.006) -> Float[np.ndarray, " N"]:
    """Return 1 within `width` metres about every multiple of `period`, 0 between, soft over `edge`."""
    distance = np.abs((x + 0.5 * period) % period - 0.5 * period)
    return ramp(distance, 0.5 * (width + edge), 0.5 * (width - edge))


def mix_rows(colors: Float[np.ndarray, "N 3"], other: Color, t: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
    """Return each colour mixed with one other, which has the share `t`."""
    return colors + np.asarray(t, dtype=float)[:, None] * (np.asarray(other, dtype=float) - colors)


def weave(points: Float[np.ndarray, "N 3"], *, seed: int) -> Float[np.ndarray, " N"]:
    """Return noise of about unit size: uneven threads along and across, which show no moire from afar."""
    along = smooth_noise(points, scale=(0.0006, 0.010, 0.0006), seed=seed)
    across = smooth_noise(points, scale=(0.010, 0.0006, 0.010), seed=seed + 1)
    patches = smooth_noise(points, scale=(0.02, 0.02, 0.02), seed=seed + 2)
    return 0.6 * along + 0.6 * across + 0.5 * patches


_LIGHT, _DARK = (222, 214, 196), (58, 40, 92)  # colours of all skirt patterns but the plaid


def _plaid(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Return broad dark bands and thin light lines, around and along."""
    ground, dark_band, thin_line = (150, 34, 44), (28, 60, 66), (236, 204, 120)
    around, y = at.T
    period = SKIRT_GIRTH / 12
    dark = 0.5 * (band(around, period=period, width=0.044) + band(y, period=0.11, width=0.044))
    colors = mix(ground, dark_band, dark)
    line = np.maximum(
        band(around + 0.5 * period, period=period, width=0.009), band(y + 0.055, period=0.11, width=0.009)
    )
    return colors + 0.8 * line[:, None] * (np.array(thin_line) - colors)


def _stripes(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return mix(_LIGHT, _DARK, band(at[:, 0], period=SKIRT_GIRTH / 22, width=0.03))


def _hoops(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return mix(_LIGHT, _DARK, band(at[:, 1], period=0.06, width=0.03))


def _dots(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Return dots of 24 mm, 51 mm apart; every other row is shifted by half of that."""
    across, down = SKIRT_GIRTH / 26, 0.05
    row = np.round(at[:, 1] / down)
    place = at[:, 0] / across + 0.5 * (row % 2)
    away = np.hypot(across * (place - np.round(place)), at[:, 1] - down * row)
    return mix(_DARK, _LIGHT, np.clip((0.015 - away) / 0.006, 0.0, 1.0))


def _plain(at: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return mix(_LIGHT, _DARK, np.full(len(at), 0.5))


SKIRT_PATTERNS: dict[str, Callable[[Float[np.ndarray, "N 2"]], Float[np.ndarray, "N 3"]]] = {
    "plaid": _plaid,
    "stripes": _stripes,
    "hoops": _hoops,
    "dots": _dots,
    "plain": _plain,
}
"""Each maps metres around and along the skirt to sRGB, 0 to 255. Stripes run down it, hoops around it."""


def around_and_along(offsets: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """Return metres around and along a skirt of points, given from a point on its axis, y."""
    x, y, z = offsets.T
    return np.stack([np.arctan2(x, z) * SKIRT_RADIUS, y], axis=1)


def skirt_colors(points: Float[np.ndarray, "N 3"], centre_z: float, pattern: str = "plaid") -> Float[np.ndarray, "N 3"]:
    """Return colours of one of `SKIRT_PATTERNS` in wool, whose uneven threads all but the plain one show."""
    colors = SKIRT_PATTERNS[pattern](around_and_along(points - np.array([0.0, 0.0, centre_z])))
    return colors if pattern == "plain" else colors * (1.0 + 0.09 * weave(points, seed=12))[:, None]
