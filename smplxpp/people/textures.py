"""Make procedural colours of skin, face, hair and clothes from the point on the T-pose, and their patterns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from smplxpp.core.mesh import row_lengths

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


def _plaid(at: Float[np.ndarray, "N _"]) -> Float[np.ndarray, "N 3"]:
    """Return broad dark bands and thin light lines, around and along."""
    ground, dark_band, thin_line = (150, 34, 44), (28, 60, 66), (236, 204, 120)
    around, y = at[:, :2].T
    period = SKIRT_GIRTH / 12
    dark = 0.5 * (band(around, period=period, width=0.044) + band(y, period=0.11, width=0.044))
    colors = mix(ground, dark_band, dark)
    line = np.maximum(
        band(around + 0.5 * period, period=period, width=0.009), band(y + 0.055, period=0.11, width=0.009)
    )
    return colors + 0.8 * line[:, None] * (np.array(thin_line) - colors)


def _stripes(at: Float[np.ndarray, "N _"]) -> Float[np.ndarray, "N 3"]:
    return mix(_LIGHT, _DARK, band(at[:, 0], period=SKIRT_GIRTH / 22, width=0.03))


def _hoops(at: Float[np.ndarray, "N _"]) -> Float[np.ndarray, "N 3"]:
    return mix(_LIGHT, _DARK, band(at[:, 1], period=0.06, width=0.03))


def _dots(at: Float[np.ndarray, "N _"]) -> Float[np.ndarray, "N 3"]:
    """Return dots of 24 mm, 51 mm apart; every other row is shifted by half of that.

    A third column of `at` is the length of cloth per length around where a skirt flares, so that dots stay round.
    """
    across, down = SKIRT_GIRTH / 26, 0.05
    row = np.round(at[:, 1] / down)
    place = at[:, 0] / across + 0.5 * (row % 2)
    beside = across * (place - np.round(place))
    away = np.hypot(beside if at.shape[1] == 2 else at[:, 2] * beside, at[:, 1] - down * row)
    return mix(_DARK, _LIGHT, np.clip((0.015 - away) / 0.006, 0.0, 1.0))


def _plain(at: Float[np.ndarray, "N _"]) -> Float[np.ndarray, "N 3"]:
    return mix(_LIGHT, _DARK, np.full(len(at), 0.5))


SKIRT_PATTERNS: dict[str, Callable[[Float[np.ndarray, "N _"]], Float[np.ndarray, "N 3"]]] = {
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


def evenly_around(offsets: Float[np.ndarray, "N 3"], hem: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "N 3"]:
    """Return metres around (shares of the hem's length) and along a skirt, and its girth over `SKIRT_GIRTH`.

    Args:
        offsets: from a point on the skirt's axis, y.
        hem: the loop of its hem, from the same point.
    """
    # Lengths along the hem by angle; both close after one turn.
    angle = np.arctan2(hem[:, 0], hem[:, 2])
    order = np.argsort(angle)
    angle, hem = angle[order], hem[order]
    steps = row_lengths(np.diff(hem, axis=0, append=hem[:1]))
    around = np.append(0.0, np.cumsum(steps)) - 0.5 * steps.sum()
    angle = np.append(angle, angle[0] + 2 * np.pi)
    x, y, z = offsets.T
    turned = (np.arctan2(x, z) - angle[0]) % (2 * np.pi) + angle[0]
    radius = np.hypot(hem[:, 0], hem[:, 2])
    narrower = np.hypot(x, z) / np.interp(turned, angle, np.append(radius, radius[0]))
    share = SKIRT_GIRTH / steps.sum()
    return np.stack([share * np.interp(turned, angle, around), y, narrower / share], axis=1)


def skirt_colors(
    points: Float[np.ndarray, "N 3"],
    centre_z: float,
    pattern: str = "plaid",
    hem: Float[np.ndarray, "L 3"] | None = None,
) -> Float[np.ndarray, "N 3"]:
    """Return colours of one of `SKIRT_PATTERNS` in wool, whose uneven threads all but the plain one show.

    Args:
        points: on the T-pose, metres.
        centre_z: depth of the skirt's axis.
        pattern: name of the pattern.
        hem: the loop of the hem, along whose length the pattern is spread; None: by the angle around the axis.
    """
    centre = np.array([0.0, 0.0, centre_z])
    at = around_and_along(points - centre) if hem is None else evenly_around(points - centre, hem - centre)
    colors = SKIRT_PATTERNS[pattern](at)
    return colors if pattern == "plain" else colors * (1.0 + 0.09 * weave(points, seed=12))[:, None]


SKIN = (222, 176, 150)
_BROWS, _PUPIL = (66, 44, 32), (18, 14, 14)


def shirt_colors(points: Float[np.ndarray, "N 3"], shoulder: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "N 3"]:
    """Return stripes around torso and sleeves, in an uneven knit."""
    shirt, stripe = (240, 236, 226), (44, 62, 110)
    x, y, _ = points.T
    start = shoulder[0] + 0.03
    on_sleeve = (np.abs(x) > start) & (y > shoulder[1] - 0.13)
    along = np.where(on_sleeve, np.abs(x) - start, y)
    colors = mix(shirt, stripe, band(along, period=0.048, width=0.02))
    return colors * (1.0 + 0.045 * weave(points, seed=11))[:, None]


def trouser_colors(
    points: Float[np.ndarray, "N 3"], hip: Float[np.ndarray, " 3"], ankle: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "N 3"]:
    """Return denim, worn on thighs and knees, with a seam along the outside of each leg and two rings at each knee.

    Args:
        points: on the T-pose, metres.
        hip: joint of the left leg.
        ankle: joint of the left leg.
    """
    denim, worn_denim, thread = (52, 74, 108), (104, 128, 158), (198, 148, 88)
    x, y, z = points.T
    along = np.clip((hip[1] - y) / (hip[1] - ankle[1]), 0.0, 1.0)
    # Offsets from the leg's axis: to the front, and to the outside.
    front, outside = z - (hip[2] + along * (ankle[2] - hip[2])), np.abs(x) - (hip[0] + along * (ankle[0] - hip[0]))
    patches = smooth_noise(points, scale=(0.03, 0.06, 0.03), seed=13)
    worn = ramp(front, 0.0, 0.08) * np.exp(-(((along - 0.3) / 0.25) ** 2))
    colors = mix(denim, worn_denim, np.clip(0.8 * worn + 0.12 * patches, 0, 1))
    side = ramp(np.abs(front + 0.01), 0.006, 0.003) * ramp(outside, 0.02, 0.035)
    knee = band(y - 0.5 * (hip[1] + ankle[1]), period=0.05, width=0.005) * ramp(np.abs(along - 0.5), 0.06, 0.04)
    colors = colors + (0.8 * np.maximum(side, knee))[:, None] * (np.array(thread) - colors)
    return colors * (1.0 + 0.08 * weave(points, seed=14))[:, None]


def hair_colors(points: Float[np.ndarray, "N 3"], seed: int) -> Float[np.ndarray, "N 3"]:
    """Return brown hair with lighter streaks along its fall."""
    locks = smooth_noise(points, scale=(0.007, 0.3, 0.007), seed=seed)
    strands = smooth_noise(points, scale=(0.0009, 0.12, 0.0009), seed=seed + 1)
    return mix((62, 38, 24), (112, 72, 44), np.clip(0.3 + 0.22 * locks + 0.2 * strands, 0, 1))


def shoe_colors(points: Float[np.ndarray, "N 3"], floor: float) -> Float[np.ndarray, "N 3"]:
    """Return brown leather over a light sole."""
    return mix((232, 226, 214), (124, 74, 46), ramp(points[:, 1], floor + 0.010, floor + 0.016))


def skin_colors(points: Float[np.ndarray, "N 3"], face: FaceMarks, seed: int) -> Float[np.ndarray, "N 3"]:
    """Return skin with warm patches and fine mottling; on the face cheeks, lips, brows and lashes."""
    warmth = smooth_noise(points, scale=(0.04, 0.04, 0.04), seed=seed)
    mottling = smooth_noise(points, scale=(0.003, 0.003, 0.003), seed=seed + 1)
    pores = smooth_noise(points, scale=(0.0005, 0.0005, 0.0005), seed=seed + 2)
    colors = np.array(SKIN, dtype=float) + 3.0 * warmth[:, None] * [1.0, -0.6, -0.8]
    colors += (1.8 * mottling)[:, None] * [0.4, -1.0, -0.8] + (1.6 * pores)[:, None]
    near = np.flatnonzero(face.in_front(points))
    colors[near] = _face_colors(colors[near], points[near], face, seed)
    return colors


@dataclass(frozen=True, eq=False)
class FaceMarks:
    """Landmarks on the T-pose in dlib's order, metres.

    Attributes:
        brows: both eyebrows.
        eyes: outlines of both eyes.
        lips: outer outline of the lips.
    """

    brows: Float[np.ndarray, "10 3"]
    eyes: Float[np.ndarray, "12 3"]
    lips: Float[np.ndarray, "12 3"]

    def in_front(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        """Return which points lie on the front of the face."""
        low, high = self.lips.min(axis=0), self.brows.max(axis=0)
        x, y, z = points.T
        return (y > low[1] - 0.02) & (y < high[1] + 0.02) & (z > low[2] - 0.045) & (np.abs(x) < 0.075)


def _face_colors(
    colors: Float[np.ndarray, "N 3"], points: Float[np.ndarray, "N 3"], face: FaceMarks, seed: int
) -> Float[np.ndarray, "N 3"]:
    """Return skin colours with the features of the face over them, all drawn in the frontal plane."""
    # Cheeks and nose: Gaussian spots of blush.
    x, y, _ = points.T
    mirrored = np.stack([np.abs(x), y], axis=1)
    lips, eye, brow = face.lips, face.eyes[6:, :2], face.brows[5:, :2]
    cheek = np.array([1.25 * eye[:, 0].mean(), 0.5 * (eye[:, 1].mean() + lips[:, 1].mean())])
    blush = np.exp(-((row_lengths(mirrored - cheek) / 0.018) ** 2)) + 0.5 * np.exp(-((x / 0.012) ** 2))
    colors = mix_rows(colors, (224, 132, 116), 0.22 * blush * ramp(y, eye[:, 1].min(), lips[:, 1].max()))

    # Lips: the outline as a radius by angle about their middle.
    middle = lips[:, :2].mean(axis=0)
    outline = lips[:, :2] - middle
    offset = np.stack([x, y], axis=1) - middle
    order = np.argsort(np.arctan2(outline[:, 1], outline[:, 0]))
    radius = np.interp(
        np.arctan2(offset[:, 1], offset[:, 0]),
        np.arctan2(outline[:, 1], outline[:, 0])[order],
        row_lengths(outline)[order],
        period=2 * np.pi,
    )
    lines = smooth_noise(points, scale=(0.0006, 0.006, 0.006), seed=seed + 3)
    tint = ramp(row_lengths(offset) / np.maximum(radius, 1e-6), 1.0, 0.78)
    colors = mix_rows(colors, (188, 104, 98), 0.85 * tint) * (1.0 + 0.04 * tint * lines)[:, None]

    # Brows: lower and flatter than the landmarks' arc, broad inside, made of short strokes.
    t = np.clip((mirrored[:, 0] - brow[0, 0]) / (brow[-1, 0] - brow[0, 0]), 0.0, 1.0)
    lowered = np.stack([brow[:, 0], brow[:, 1] - 0.004 - 0.0045 * np.linspace(1, 0, len(brow)) ** 1.5], axis=1)
    half = 0.0038 * (1.0 - t) + 0.0014
    # Strokes lean to the same side on both halves as seen from the front.
    slant = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    strokes = smooth_noise(points @ slant.astype(points.dtype), scale=(0.0005, 0.004, 0.004), seed=seed + 4)
    cover = ramp(_off_curve(mirrored, lowered) / half, 1.25, 0.4) * np.clip(0.72 + 0.25 * strokes, 0, 1)
    colors = mix_rows(colors, _BROWS, cover)

    # Lashes: a dark line on the upper lid, a faint one on the lower.
    for lid, strength, width in ((eye[:4], 0.85, 0.0013), (eye[[0, 5, 4, 3]], 0.35, 0.0009)):
        colors = mix_rows(colors, _BROWS, strength * ramp(_off_curve(mirrored, lid), 1.6 * width, 0.4 * width))
    return colors


def _off_curve(points: Float[np.ndarray, "N 2"], curve: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, " N"]:
    """Return the approximate distance of points from a planar curve with ascending x."""
    x, y = points.T
    beside = np.maximum(np.maximum(curve[0, 0] - x, x - curve[-1, 0]), 0.0)
    return np.hypot(y - np.interp(x, curve[:, 0], curve[:, 1]), beside)


def eye_colors(offsets: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Return white, iris and pupil by the distance from the eye's axis, +z; `offsets` are from its centre, metres."""
    iris, light_iris, white = (72, 98, 84), (112, 134, 110), (232, 227, 222)
    radius, angle = np.hypot(offsets[:, 0], offsets[:, 1]), np.arctan2(offsets[:, 1], offsets[:, 0])
    fibres = 0.5 + 0.25 * np.sin(23 * angle) + 0.25 * np.sin(37 * angle + 900 * radius)
    colors = mix_rows(mix(iris, light_iris, fibres), _PUPIL, 0.6 * ramp(radius, 0.0048, 0.0058))
    colors = mix_rows(colors, white, ramp(radius, 0.0058, 0.0066))
    return mix_rows(colors, _PUPIL, ramp(radius, 0.003, 0.0022))
