"""Procedural colours of the fixture person, as functions of the point on the T-pose."""

from __future__ import annotations

import numpy as np

from pipelines.makers.garments import ramp, smooth_noise

SKIN, LIPS, BROWS, SCLERA, IRIS, PUPIL = (
    (222, 176, 150), (192, 116, 108), (74, 50, 36), (238, 234, 228), (86, 112, 96), (22, 18, 18),
)  # fmt: skip
HAIR, HAIR_LIGHT = (62, 38, 24), (112, 72, 44)
SHOE, SOLE = (124, 74, 46), (232, 226, 214)
SHIRT, STRIPE = (240, 236, 226), (44, 62, 110)
PLAID = ((150, 34, 44), (28, 60, 66), (236, 204, 120))


def mix(a, b, t: np.ndarray) -> np.ndarray:
    """(N, 3) colours between `a` (t = 0) and `b` (t = 1)."""
    t = np.asarray(t, dtype=float)[:, None]
    return (1 - t) * np.asarray(a, dtype=float) + t * np.asarray(b, dtype=float)


def band(x: np.ndarray, *, period: float, width: float, edge: float = 0.006) -> np.ndarray:
    """(N,) 1 within `width` metres about every multiple of `period`, 0 between, soft over `edge`."""
    distance = np.abs((x + 0.5 * period) % period - 0.5 * period)
    return ramp(distance, 0.5 * (width + edge), 0.5 * (width - edge))


def shirt_colors(points: np.ndarray, shoulder: np.ndarray) -> np.ndarray:
    """Stripes around torso and sleeves."""
    x, y, _ = points.T
    start = shoulder[0] + 0.03
    on_sleeve = (np.abs(x) > start) & (y > shoulder[1] - 0.13)
    along = np.where(on_sleeve, np.abs(x) - start, y)
    return mix(SHIRT, STRIPE, band(along, period=0.048, width=0.02))


def skirt_colors(points: np.ndarray, centre_z: float) -> np.ndarray:
    """A plaid: broad dark bands and thin light lines, around and along."""
    x, y, z = points.T
    around = np.arctan2(x, z - centre_z) * 0.21  # about metres on the skirt
    period = 2 * np.pi * 0.21 / 12
    dark = 0.5 * (band(around, period=period, width=0.044) + band(y, period=0.11, width=0.044))
    colors = mix(PLAID[0], PLAID[1], dark)
    line = np.maximum(
        band(around + 0.5 * period, period=period, width=0.009), band(y + 0.055, period=0.11, width=0.009)
    )
    return colors + 0.8 * line[:, None] * (np.array(PLAID[2]) - colors)


def hair_colors(points: np.ndarray, seed: int) -> np.ndarray:
    """Brown with lighter streaks along the fall."""
    streaks = smooth_noise(points, scale=(0.007, 0.3, 0.007), seed=seed)
    return mix(HAIR, HAIR_LIGHT, np.clip(0.3 + 0.3 * streaks, 0, 1))


def shoe_colors(points: np.ndarray, floor: float) -> np.ndarray:
    """Leather over a light sole."""
    return mix(SOLE, SHOE, ramp(points[:, 1], floor + 0.010, floor + 0.016))


def skin_colors(points: np.ndarray, brows: np.ndarray, lips: np.ndarray, seed: int) -> np.ndarray:
    """Skin with warm patches; `brows` (B, 3) and the outline of the `lips` (L, 3) are points on the same T-pose."""
    warmth = smooth_noise(points, scale=(0.04, 0.04, 0.04), seed=seed)
    colors = np.array(SKIN, dtype=float) + 3.0 * warmth[:, None] * [1.0, -0.6, -0.8]
    middle, half = lips.mean(axis=0), np.abs(lips - lips.mean(axis=0)).max(axis=0)
    ellipse = np.hypot((points[:, 0] - middle[0]) / half[0], (points[:, 1] - middle[1]) / half[1])
    in_front = np.abs(points[:, 2] - middle[2]) < 0.04
    colors = mix_rows(colors, LIPS, ramp(ellipse, 1.0, 0.75) * in_front)
    # Distance to the line through the brows' points: dense samples of both arcs.
    arcs = np.concatenate([_resampled(brows[:5]), _resampled(brows[5:])])
    distance = np.linalg.norm(points[:, None] - arcs[None], axis=2).min(axis=1)
    return mix_rows(colors, BROWS, 0.85 * ramp(distance, 0.0065, 0.003))


def eye_colors(offsets: np.ndarray) -> np.ndarray:
    """White, iris and pupil by the distance from the eye's axis, +z; `offsets` (N, 3) from its centre."""
    radius = np.hypot(offsets[:, 0], offsets[:, 1])
    colors = mix(IRIS, SCLERA, ramp(radius, 0.0058, 0.0066))
    return mix_rows(colors, PUPIL, ramp(radius, 0.003, 0.0022))


def mix_rows(colors: np.ndarray, other: tuple, t: np.ndarray) -> np.ndarray:
    return colors + np.asarray(t, dtype=float)[:, None] * (np.asarray(other, dtype=float) - colors)


def _resampled(line: np.ndarray, count: int = 40) -> np.ndarray:
    t = np.linspace(0, len(line) - 1, count)
    return np.stack([np.interp(t, np.arange(len(line)), line[:, axis]) for axis in range(3)], axis=1)
