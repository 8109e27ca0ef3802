"""Hair that hangs: from the skull's cap over neck, shoulders and back, as far as its colour goes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core.topology import component_labels
from smplxpp.segment.by_body_appearance import connected_to
from smplxpp.segment.by_body_chart import ARM, HEAD, NECK, TRUNK, BodyChart
from smplxpp.segment.by_body_colors import Palette
from smplxpp.segment.by_body_prior import face_core, skull_cap

_BALD = 2.0  # mean log ratio of the cap for skin
_LOWEST, _OUTMOST = 0.85, 0.2  # standard metres: how far down the trunk and along the arm hair may hang
_CLEAR = 0.7  # nats by which hair explains a colour better than all else


def is_bald(chart: BodyChart, skin_ratio: Float64[np.ndarray, " M"], area: Float64[np.ndarray, " M"]) -> bool:
    """Whether the cap has the colour of this person's skin."""
    cap = skull_cap(chart)
    return bool(cap.any() and area[cap] @ skin_ratio[cap] > _BALD * area[cap].sum())


def hanging_hair(
    chart: BodyChart,
    palette: Palette,
    skin_like: Float64[np.ndarray, " M"],
    area: Float64[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
) -> Bool[np.ndarray, " M"]:
    """Faces outside of the head that hair of the cap's colour reaches.

    Its colours are compared with those of the chest's front and all below the waist, and with skin.

    Args:
        skin_like: probability that the colour is skin. pairs: faces that share an edge.
    """
    cap = skull_cap(chart)
    trunk = chart.region == TRUNK
    front = trunk & (np.abs(chart.azimuth) < 0.7) & (chart.height > 0.95) & (chart.height < 1.3)
    below = (chart.height < 0.85) & np.isin(chart.region, (TRUNK, *range(TRUNK + 1, ARM)))
    hair = palette.histogram(area * cap * (1.0 - skin_like))
    others = [palette.histogram(area * x) for x in (front * (1 - skin_like), below * (1 - skin_like), skin_like)]
    ratio = np.log(hair) - np.log(np.max(others, axis=0))
    alike = ratio[palette.index]
    may = (
        ((chart.region == HEAD) & ~face_core(chart))
        | (chart.region == NECK)
        | (trunk & (chart.height > _LOWEST))
        | ((chart.region == ARM) & (chart.reach < _OUTMOST))
    )
    mean = alike.copy()
    for _ in range(6):
        total = np.bincount(pairs.ravel(), mean[pairs[:, ::-1]].ravel(), minlength=len(mean))
        count = np.bincount(pairs.ravel(), minlength=len(mean))
        mean = (mean + total) / (1 + count)
    grown = may & (mean > _CLEAR)
    inside = grown[pairs].all(axis=1)
    component = component_labels(pairs[inside], len(mean))
    return connected_to(grown, cap, component) & (chart.region != HEAD)
