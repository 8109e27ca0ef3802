"""Bound the confidence of labels by that of the outline, and note what cannot be decided."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from scipy.ndimage import maximum_filter1d

from smplxpp.core import HAIR, LABELS, LOWER, OUTER, SKIN, UPPER
from smplxpp.segment.by_body_chart import ARM, HEAD, HIP, LEG, REGION_NAMES, TRUNK, BodyChart, in_arm, in_column
from smplxpp.segment.by_body_colors import SkinModel
from smplxpp.segment.by_body_layers import Layers
from smplxpp.segment.by_body_outfit import RUNS, Outfit
from smplxpp.segment.by_body_rings import ARM_START, COLUMN_END, STEP

BODY_ELSEWHERE = 0.05
"""Distance, in metres, between body and bare skin from which the body is not the scan's."""
_LEAST_OFF = 0.006
"""Square metres of skin off the body that are reported, as of the smallest thing in a hand."""
_BESIDE, _LEAST_BESIDE = 0.08, 0.03
"""Metres off the body, and square metres there on one side, from which clothes are reported as a bag. Of 9 real people
without one a jacket at a hand in its pocket has most, 0.023, and a tenth of that on the other side."""
_BORDERS = {
    "shoe_top": "where shoes or socks end",
    "lower_start": "where the lower garment's hem is",
    "lower_end": "where the lower garment's waist is",
    "upper_start": "where the upper garment's hem is",
    "cuff": "where the sleeves end",
}


_NO_HEM = "no hem on trunk, arms and legs: taken as bare skin"
TAKEN_AS_BARE = f"{_NO_HEM}; tight clothes may look the same"
UNSURE = 0.6
"""Confidence below which a label is uncertain: it is reported, drawn pale, and no label for fits."""


def confidence_bound(
    chart: BodyChart, labels: Int64[np.ndarray, " M"], outfit: Outfit, layers: Layers, *, colored: bool = True
) -> Float64[np.ndarray, " M"]:
    """Return the upper bound of each face's confidence: P(its label) over all outlines of the clothes.

    A face whose label does not come from the outline (a neckline, a bib) was decided by its colour: its bound is 1.
    """
    most = np.ones(len(labels))
    column, arm = in_column(chart), in_arm(chart)
    # Column: the bound is the ring's probability where the chosen outline has the label in the ring or near it.
    told, shares = _labels_of_outline(outfit), _around(outfit.column)
    ring = np.clip(np.floor(chart.height[column] / STEP).astype(np.int64), 0, len(shares) - 1)
    own = labels[column]
    most[column] = np.where(told[ring, own], shares[ring, own], 1.0)
    # Arms: the bound is the probability of sleeve or of bare skin.
    sleeve, bare = _around(outfit.sleeve), _around(1.0 - outfit.sleeve)
    ring = np.clip(np.floor((chart.reach[arm] - ARM_START) / STEP).astype(np.int64), 0, len(sleeve) - 1)
    own = labels[arm]
    most[arm] = np.where(own == UPPER.id, sleeve[ring], np.where(own == SKIN.id, bare[ring], 1.0))
    # Precision of rules on the procedural people of the benchmark `labels_by_body`, without colours on public
    # scans too, as the mean over people; leaving one out changes it by at most 0.17. One garment over trunk and legs
    # is `upper`, although a truth may call a dress lower (one of five without a seam at the waist), or two garments of
    # one cloth look like one; an `upper` without a coat is no jacket, cape or waistcoat.
    upper = labels == UPPER.id
    if outfit.one_piece:
        most[upper & np.isin(chart.region, (TRUNK, LEG))] *= 0.8 if outfit.seamless else 0.55
    if not layers.coat.any():
        most[upper] *= 0.93
    # Without colours skin and what lies on it like skin, leggings and tight tops, look the same. Three of four such
    # people are bare; 0.57 is the least share of right area that leaving one out gives, below `UNSURE`. Legs
    # below a garment that ends at the crotch are the same, as one man's in tight jeans below a wide T-shirt.
    if not colored:
        parts = [TRUNK, ARM] if outfit.upper_start >= COLUMN_END - 1e-9 else []
        parts += [LEG] if not outfit.has_lower and outfit.upper_start > HIP - 0.2 else []
        most[(labels == SKIN.id) & np.isin(chart.region, parts)] *= 0.57
    scalp = (chart.region == HEAD) & ~chart.face_core & np.isin(labels, (HAIR.id, SKIN.id))
    most[scalp] = np.minimum(most[scalp], layers.scalp)
    # Nothing shows how far a coat or cape reaches, or whether cloth without a seam at the waist is one garment.
    vague, cloth = 0.59, np.isin(labels, (UPPER.id, LOWER.id, OUTER.id))
    if layers.vague is not None:
        most[layers.vague & cloth] = np.minimum(most[layers.vague & cloth], vague)
    if outfit.seamless and not outfit.one_piece:
        cloth &= np.isin(chart.region, (TRUNK, LEG))
        most[cloth] = np.minimum(most[cloth], vague)
    # A waist at which nothing steps is a guess: at 17 of 21 in scans of 46 people a fifth of the area within 12 cm or
    # more is wrong, at a third of those with a step above 3 nats. 0.6 of the area is right there.
    step_seen, about = 1.0, 0.12
    if outfit.has_lower and outfit.waist_step < step_seen:
        beside = np.isin(labels, (UPPER.id, LOWER.id)) & np.isin(chart.region, (TRUNK, LEG))
        most[beside & (np.abs(chart.height - outfit.upper_start) < about)] *= vague
    return most


def _labels_of_outline(outfit: Outfit) -> np.ndarray:
    """Return (R, L) bools: whether the chosen outline has the label in the ring or near it."""
    middle = STEP * (np.arange(len(outfit.column)) + 0.5)
    borders = (outfit.shoe_top, outfit.lower_start, outfit.lower_end, outfit.upper_start)
    label = np.array([label.id for label in RUNS])[np.searchsorted(borders, middle, side="right")]
    return _around((label[:, None] == np.arange(len(LABELS))).astype(np.float64)) > 0


def _around(shares: np.ndarray) -> np.ndarray:
    """Return the maximum over five rings around each ring, because a hem may lie up to two rings beside its own."""
    return np.asarray(maximum_filter1d(shares, 5, axis=0, mode="nearest"))


def notes_on_labels(
    chart: BodyChart,
    area: Float64[np.ndarray, " M"],
    labels: Int64[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
    outfit: Outfit,
    skin: SkinModel | None,
    *,
    misfit: float,
    hanging: bool = False,
) -> tuple[str, ...]:
    """Return notes on labels that are uncertain, for the user; empty where everything is clear."""
    # Colours and skin: what the labels depend on.
    out = []
    if skin is None:
        out.append("the scan has no colours: labels rest on the distance to the body alone")
    elif not skin.found:
        out.append("neither the face nor the hands show skin: a generic range of skin colours is used")
    elif skin.hands is False:
        out.append("hands and face differ in colour (gloves, a covered face): skin has the colour of the face")
    # The body: distances above 12 mm cannot tell skin from thin cloth.
    if misfit > BODY_ELSEWHERE:
        out.append(f"the body lies {1e3 * misfit:.0f} mm from the scan's face and hands: no label can be trusted")
    elif misfit > 0.012:
        out.append(f"the body misses face and hands by {1e3 * misfit:.0f} mm: clothes are recognised by colour alone")
    out.extend(notes_on_worn_things(chart, area, labels, misfit=misfit))
    # The outline: borders for which another place costs less than 6 nats more.
    close = [_BORDERS[name] for name, margin in outfit.margins.items() if margin < 6.0]
    out.extend(f"it is a close call {words}" for words in dict.fromkeys(close))
    if outfit.one_piece:
        out.append("no seam at the waist: taken as one garment (dress, jumpsuit), labelled upper")
    elif outfit.seamless:
        out.append("no seam at the waist: may be one garment (jumpsuit, overalls) or two; both are labelled")
    elif outfit.unclothed:
        out.append(TAKEN_AS_BARE if skin is None else f"{_NO_HEM}; clothes in its colour may look the same")
    if hanging:
        out.append("cloth hangs off the legs: nothing shows how far a cape reaches above, or a coat from a skirt")
    # The parts of the body on which most of the uncertain area lies, if that is more than 5 % of the surface.
    low = confidence < UNSURE
    pairs = np.stack([chart.region[low], labels[low]], axis=1)
    share = float(area[low].sum() / max(area.sum(), 1e-12))
    if share > 0.05:
        kinds, which = np.unique(pairs, axis=0, return_inverse=True)
        total = np.bincount(which.ravel(), area[low]) / area.sum()
        parts = [
            f"{REGION_NAMES[kinds[k, 0]]} as {LABELS[kinds[k, 1]].name} {total[k]:.0%}"
            for k in np.argsort(-total)[:3]
            if total[k] > 0.01
        ]
        out.append(
            f"not sure of {int(low.sum())} faces, {share:.0%} of the surface ({', '.join(parts)}): look at the labels, "
            "correct them with `smplxpp label`, or give --labels, colours or photographs"
        )
    return tuple(out)


def notes_on_worn_things(
    chart: BodyChart, area: Float64[np.ndarray, " M"], labels: Int64[np.ndarray, " M"], *, misfit: float
) -> list[str]:
    """Return notes on skin far off the body and on clothes far off one side of it: bags, hats, hair.

    Args:
        chart: places of the faces on the body.
        area: of the faces, square metres.
        labels: of the faces.
        misfit: distance between body and bare skin, metres; a body that is elsewhere tells nothing.
    """
    if misfit > BODY_ELSEWHERE:
        return []
    out = []
    off = float(area[(labels == SKIN.id) & (chart.distance > BODY_ELSEWHERE)].sum())
    if off > _LEAST_OFF:
        out.append(
            f"{1e4 * off:.0f} cm2 labelled skin stand more than {1e2 * BODY_ELSEWHERE:.0f} cm off the body: something "
            "worn or held, or hair; label it (`smplxpp label`)"
        )
    # A skirt or a coat stands off both sides of a person, a bag on a strap off one.
    cloth = np.isin(labels, (UPPER.id, LOWER.id)) & (chart.distance > _BESIDE)
    left, right = (float(area[cloth & (sign * chart.side > 0)].sum()) for sign in (1, -1))
    if max(left, right) > max(_LEAST_BESIDE, 10.0 * min(left, right)):
        side = "left" if left > right else "right"
        out.append(
            f"{1e4 * max(left, right):.0f} cm2 of clothes stand more than {1e2 * _BESIDE:.0f} cm off the {side} side "
            "alone: a bag may be worn there; label it object (`smplxpp label`) and build with --rules object "
            "rigid:pelvis, or it follows a hand that touches it"
        )
    return out
