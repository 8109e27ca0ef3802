"""How sure a label can be, given how sure the outline is that it rests on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from scipy.ndimage import maximum_filter1d

from smplxpp.core.labels import LABELS, SKIN, UPPER
from smplxpp.segment.by_body_chart import LEG, TRUNK, BodyChart
from smplxpp.segment.by_body_layers import Layers
from smplxpp.segment.by_body_outfit import ARM_START, RUNS, STEP, Outfit, in_arm, in_column

_NEAR = 2  # rings by which a hem may lie elsewhere than its ring
# Shares among the people of `benchmarks.people`: of what was called upper where no coat was found, what was no jacket,
# cape or waistcoat; of what covers trunk and legs in one, what is upper (a truth may call a dress a lower garment, or
# it is two garments of one cloth).
_NO_JACKET, _ONE_PIECE = 0.93, 0.55


def most_certain(
    chart: BodyChart, labels: Int64[np.ndarray, " M"], outfit: Outfit, layers: Layers
) -> Float64[np.ndarray, " M"]:
    """The most confidence that each face may have: P(its label) by all outlines that there might be.

    A face whose label the outline has not there (a neckline, a bib) was told by its colour: 1.
    """
    most = np.ones(len(labels))
    column, arm = in_column(chart), in_arm(chart)
    told, shares = _told_by_column(outfit), _around(outfit.column)
    ring = np.clip(np.floor(chart.height[column] / STEP).astype(np.int64), 0, len(shares) - 1)
    own = labels[column]
    most[column] = np.where(told[ring, own], shares[ring, own], 1.0)
    sleeve, bare = _around(outfit.sleeve), _around(1.0 - outfit.sleeve)
    ring = np.clip(np.floor((chart.reach[arm] - ARM_START) / STEP).astype(np.int64), 0, len(sleeve) - 1)
    own = labels[arm]
    most[arm] = np.where(own == UPPER.id, sleeve[ring], np.where(own == SKIN.id, bare[ring], 1.0))
    upper = labels == UPPER.id
    if outfit.one_piece:
        most[upper & np.isin(chart.region, (TRUNK, LEG))] *= _ONE_PIECE
    if not layers.coat.any():
        most[upper] *= _NO_JACKET
    return most


def _told_by_column(outfit: Outfit) -> np.ndarray:
    """(R, L) whether the outline that was taken has the label in the ring or near it."""
    middle = STEP * (np.arange(len(outfit.column)) + 0.5)
    borders = (outfit.shoe_top, outfit.lower_start, outfit.lower_end, outfit.upper_start)
    label = np.array([label.id for label in RUNS])[np.searchsorted(borders, middle, side="right")]
    return _around((label[:, None] == np.arange(len(LABELS))).astype(np.float64)) > 0


def _around(shares: np.ndarray) -> np.ndarray:
    """The most of the rings around each."""
    return np.asarray(maximum_filter1d(shares, 2 * _NEAR + 1, axis=0, mode="nearest"))
