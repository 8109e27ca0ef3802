"""Compute P(label | place on the body) from the outline of the clothes and the layers over them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.core.labels import HAIR, LABELS, LOWER, OUTER, SHOE, SKIN, UPPER
from smplxpp.segment.by_body_chart import ARM, FOOT, HAND, HEAD, LEG, NECK, NECK_BASE, TRUNK, WRIST, BodyChart
from smplxpp.segment.by_body_layers import Layers
from smplxpp.segment.by_body_outfit import Outfit
from smplxpp.segment.by_body_rings import COLUMN_END
from smplxpp.segment.by_body_waist import Waist

# Probability of each label in a region independent of the outline: the frequency of exceptions (a bag, a rolled
# sleeve).
_ELSE: dict[int, dict[int, float]] = {
    TRUNK: {SKIN.id: 0.03, HAIR.id: 0.02, UPPER.id: 0.03, LOWER.id: 0.02, OUTER.id: 0.005},
    ARM: {SKIN.id: 0.03, HAIR.id: 0.003, UPPER.id: 0.04, LOWER.id: 0.0005, OUTER.id: 0.005},
    HAND: {SKIN.id: 0.05, UPPER.id: 0.03, LOWER.id: 0.002, OUTER.id: 0.003},
    LEG: {SKIN.id: 0.04, SHOE.id: 0.01, UPPER.id: 0.02, LOWER.id: 0.04, OUTER.id: 0.003},
    FOOT: {SKIN.id: 0.03, SHOE.id: 0.06, LOWER.id: 0.02, UPPER.id: 0.001},
}
_BEYOND = 1e-3  # probability of what the surface shows not to be: a garment past its border, skin far off the face


def place_prior(
    chart: BodyChart,
    outfit: Outfit,
    layers: Layers,
    *,
    softness: float,
    body_softness: float,
    waist: Waist | None = None,
    collar: Bool[np.ndarray, " M"] | None = None,
) -> Float64[np.ndarray, "M L"]:
    """Return P(label) at each face's place, before its colour is used; rows sum to 1.

    Args:
        chart: places of the faces.
        outfit: outline of the clothes.
        layers: layers over other clothes.
        softness: standard deviation of a hem about its ring, metres.
        body_softness: standard deviation of the body's place at head and hands, metres.
        waist: border of upper and lower garment that the surface shows, which goes before the outline's.
        collar: faces of what stands all round the neck (`standing_collar`); None: there are none.
    """
    # Probability of labels that do not occur in a region; keeps logarithms finite.
    never = 1e-6
    # Exceptions first; the outline shares out the rest.
    out = np.full((len(chart.region), len(LABELS)), never)
    for region, shares in _ELSE.items():
        here = chart.region == region
        for label, share in shares.items():
            out[here, label] += share
    column, arm = np.isin(chart.region, (TRUNK, LEG, FOOT)), chart.region == ARM
    rest = 1.0 - out.sum(axis=1)
    out[column] += rest[column, None] * _column(chart.height[column], outfit, softness)
    # What hangs farther off a foot than leather is no shoe: the hem of wide trousers or of a dress over it.
    off_foot, off_back = 0.08, 0.035
    out[column & (chart.distance > off_foot), SHOE.id] *= _BEYOND
    top = chart.region == TRUNK
    if waist is not None:
        _cut_at(waist, out, softness)
        # Nor does the lower garment go on above it, whatever its colour.
        out[top & (chart.height > waist.top), LOWER.id] *= _BEYOND
    # Necklines: where the trunk meets the neck, skin replaces up to 45 % of the shirt.
    bare = 0.45 * _above(chart.height[top], NECK_BASE - 0.05, 0.03)
    out[top, SKIN.id], out[top, UPPER.id] = out[top, SKIN.id] + bare, out[top, UPPER.id] * (1 - bare)
    # Behind, below the neck, a ponytail or a hood stands off the back, and no skin.
    behind = top & (chart.height > NECK_BASE - 0.25) & (np.abs(chart.azimuth) > 0.5 * np.pi)
    behind &= chart.distance > off_back
    out[behind, HAIR.id] += (1.0 - _BEYOND) * out[behind, SKIN.id]
    out[behind, SKIN.id] *= _BEYOND
    # Arms and hands: sleeve up to the cuff, then skin.
    sleeve = 1.0 - _above(chart.reach[arm], outfit.cuff, softness)
    out[arm, UPPER.id] += rest[arm] * sleeve
    out[arm, SKIN.id] += rest[arm] * (1 - sleeve)
    hand = chart.region == HAND
    sleeve = 1.0 - _above(chart.reach[hand], min(outfit.cuff, WRIST) + 0.02, softness)
    out[hand, UPPER.id] += rest[hand] * sleeve
    out[hand, SKIN.id] += rest[hand] * (1 - sleeve)
    # Neck and head do not depend on the outline.
    neck = chart.region == NECK
    out[neck] += _neck(chart.azimuth[neck])
    head = chart.region == HEAD
    out[head] += _head(chart.azimuth[head], chart.face_height[head], body_softness)
    # What stands farther off a face than nose and ears do is hair, a beard, or the brim of a hat.
    off_face = 0.035
    off = head & (chart.distance > off_face)
    out[off, HAIR.id] += (1.0 - _BEYOND) * out[off, SKIN.id]
    out[off, SKIN.id] *= _BEYOND
    if collar is not None:
        # Hair does not go round a throat, but long hair may lie on a collar.
        over = 0.1
        out[collar, UPPER.id] += (1.0 - over) * out[collar, HAIR.id]
        out[collar, HAIR.id] *= over
    out /= out.sum(axis=1, keepdims=True)
    # Layers replace the outline where they were found.
    if layers.bald:
        out[~off, HAIR.id] *= 0.02
    if layers.bib:
        front = top & (np.abs(chart.azimuth) < 1.2)
        out[front] = 0.6 * out[front] + 0.4 * _only(LOWER.id)
    # Probability that a layer that was found is none.
    unlayered = 0.2
    for mask, worn in ((layers.hair, HAIR), (layers.coat, OUTER)):
        out[mask] = unlayered * out[mask] + (1.0 - unlayered) * _only(worn.id)
    return out / out.sum(axis=1, keepdims=True)


def standing_collar(chart: BodyChart, area: Float64[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """Return the faces off neck and chin where these stand off all round the neck, as a turned-up collar does, or none.

    In each of five sectors half of the neck's area has to stand 15 mm off. Of twelve people in public scans the one in
    such a collar has 0.63 and more of each, in two poses; a ponytail over a shirt's collar has 0.27 behind.
    """
    neck, turn = chart.region == NECK, np.abs(chart.azimuth)
    off = neck & (chart.distance > 0.015)
    sectors, least = np.digitize(turn, [0.5, 1.05, 1.6, 2.4]), 0.5
    share, whole = (np.bincount(sectors[part], area[part], minlength=5) for part in (off, neck))
    if (share <= least * whole).any():
        return np.zeros(len(area), dtype=bool)
    return off | ((chart.region == HEAD) & (chart.distance > 0.035) & (chart.face_height < 0.1))


def _cut_at(waist: Waist, out: np.ndarray, softness: float) -> None:
    """Share the probability of upper and lower garment on each side of a border, by the distance to it."""
    at = waist.faces
    both = out[at, UPPER.id] + out[at, LOWER.id]
    # Softness of such a border, as a share of a ring's.
    sharp = 0.4
    upper = _above(np.where(waist.upper[at], 1.0, -1.0) * waist.away[at], 0.0, sharp * softness)
    upper = _BEYOND + (1.0 - 2.0 * _BEYOND) * upper
    out[at, UPPER.id], out[at, LOWER.id] = both * upper, both * (1.0 - upper)


def _only(label: int) -> np.ndarray:
    return (np.arange(len(LABELS)) == label).astype(np.float64)


def _above(x: np.ndarray, border: float, softness: float) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip((x - border) / (0.5 * softness), -40, 40)))


def _column(height: np.ndarray, outfit: Outfit, softness: float) -> np.ndarray:
    out = np.zeros((len(height), len(LABELS)))
    borders = [outfit.shoe_top, outfit.lower_start, outfit.lower_end, outfit.upper_start]
    above = [np.ones(len(height))]
    for k, border in enumerate(borders):
        # A garment that is not worn has no border.
        never = (k == 0 and outfit.shoe_top <= 0) or (k == 3 and outfit.upper_start <= 0)
        # Nor has one that begins where the column ends: a bare trunk is bare up to the neck.
        nowhere = border >= COLUMN_END - 1e-9
        above.append(
            np.zeros(len(height)) if nowhere else np.ones(len(height)) if never else _above(height, border, softness)
        )
    above.append(np.zeros(len(height)))
    above = list(np.minimum.accumulate(above))
    for k, label in enumerate((SHOE, SKIN, LOWER, SKIN, UPPER)):
        out[:, label.id] += above[k] - above[k + 1]
    return np.maximum(out, 0.0)


def _neck(azimuth: np.ndarray) -> np.ndarray:
    back = np.abs(azimuth) / np.pi
    out = np.zeros((len(azimuth), len(LABELS)))
    out[:, SKIN.id], out[:, HAIR.id] = 0.75 - 0.35 * back, 0.03 + 0.35 * back
    out[:, UPPER.id], out[:, OUTER.id] = 0.2, 0.02
    return out


def _head(azimuth: np.ndarray, height: np.ndarray, softness: float) -> np.ndarray:
    """Return P(label) on the head: face, ears and nape are skin, the cap is hair; between them the colour decides."""
    side = np.abs(azimuth)
    # The hairline: over the forehead in front, before and behind the ears, down to the nape.
    line = np.interp(side, [0.0, 0.8, 1.2, 1.5, 2.0, np.pi], [0.82, 0.76, 0.62, 0.50, 0.15, 0.02])
    width = np.interp(side, [0.0, 0.8, 1.2, np.pi], [0.10, 0.12, 0.2, 0.22]) + 2.0 * softness
    hair = 1.0 / (1.0 + np.exp(-np.clip((height - line) / (0.35 * width), -30, 30)))
    hair = np.clip(hair, np.interp(side, [0.5, 1.0, 1.4], [0.002, 0.03, 0.1]), 0.95)
    out = np.zeros((len(azimuth), len(LABELS)))
    out[:, HAIR.id], out[:, SKIN.id] = hair, 1.0 - hair
    out[:, UPPER.id] = 0.01
    return out
