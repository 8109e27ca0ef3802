"""Observe a clothed scan in rings along the body: colours, distance to the body, what the body misses there, hems.

Constants were chosen on the procedural people of the benchmark `labels_by_body`, on those, too, whose limbs no shape
of the body model has (`--outsiders`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import median_filter

# Rings in standard metres: their length, the end of the column, and the ends of the arm.
STEP = 0.015
COLUMN_END, ARM_START, ARM_END = 1.32, -0.06, 0.62


@dataclass(frozen=True, eq=False)
class Rings:
    """Observations along a column or an arm, a row for each ring of `STEP`.

    Attributes:
        start: place of the first ring.
        weight: visible share of the ring, 0 to 1.
        colors: histograms; rows sum to 1.
        skin: means of the positive and the negative part of the log ratio for skin, both as positive numbers.
        distance: mean distance to the body, metres. A misplaced body is too near on one side and too far on the other,
            which leaves the mean.
        spread: robust standard deviation of the distance within the ring and 10 cm about it, metres: what the body
            misses there by, and folds.
    """

    start: float
    weight: Float64[np.ndarray, " R"]
    colors: Float64[np.ndarray, "R K"]
    skin: Float64[np.ndarray, "R 2"]
    distance: Float64[np.ndarray, " R"]
    spread: Float64[np.ndarray, " R"]

    @staticmethod
    def of(
        place: np.ndarray,
        start: float,
        end: float,
        *,
        area: np.ndarray,
        color: np.ndarray,
        color_count: int,
        skin: np.ndarray,
        distance: np.ndarray,
        used: np.ndarray,
    ) -> Rings:
        """Gather faces by their place along the column.

        Args:
            place: places of some faces.
            start: place of the first ring.
            end: place where the last ring ends.
            area: areas of the faces.
            color: palette index of the faces.
            color_count: number of colours of the palette.
            skin: log ratio of the faces' colours for skin.
            distance: distances to the body.
            used: which faces count; a ring with few of them left has a small weight.
        """
        # Area-weighted histograms and means of the used faces. A ring weighs 1 if half of its usual area is used.
        count = round((end - start) / STEP)
        ring = np.floor((place - start) / STEP).astype(np.int64)
        inside = (ring >= 0) & (ring < count)
        whole = np.bincount(ring[inside], area[inside], minlength=count)
        inside &= used
        ring, area, color, skin, distance = (x[inside] for x in (ring, area, color, skin, distance))
        total = np.bincount(ring, area, minlength=count)
        share = np.maximum(total, 1e-12)
        colors = np.bincount(ring * color_count + color, area, minlength=count * color_count)
        parts = [np.bincount(ring, area * np.maximum(sign * skin, 0), minlength=count) / share for sign in (1, -1)]
        usual = float(np.median(whole[whole > 0])) if (whole > 0).any() else 1.0
        return Rings(
            start,
            np.clip(2.0 * np.minimum(total / usual, total / np.maximum(whole, 1e-12)), 0, 1),
            colors.reshape(count, color_count) / share[:, None],
            np.stack(parts, axis=1),
            np.bincount(ring, area * np.clip(distance, -0.03, 0.08), minlength=count) / share,
            _spreads(ring, distance, count),
        )

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def places(self) -> Float64[np.ndarray, " R1"]:
        """Return the starts of the rings and the end of the last one."""
        return self.start + STEP * np.arange(len(self) + 1)

    def looks_like_skin(self, low: float, high: float) -> bool:
        """Return whether the rings between two places look like skin, by more than 1 nat on average."""
        between = (self.places[:-1] >= low) & (self.places[:-1] < high)
        return bool(between.any() and self.skin[between, 0].mean() > 1.0)


def cloth_against_skin(
    distance: Float64[np.ndarray, " n"], spread: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Return the log ratio of densities of a distance to the body under cloth and on skin, bounded to [-4, 3] nats.

    Skin is where the body is, or beside it where no shape of the model has a limb's: an even mixture of normal
    distributions of 2 and 8 mm, widened by `spread`. Cloth has a gamma distribution of order 2 and mode 7 mm: it lies
    some millimetres to some centimetres above the body and never on it.

    Args:
        distance: metres, negative within the body.
        spread: standard deviation of the body's own misfit there, metres.
    """
    mode = 0.007
    skin = np.zeros(len(distance))
    for own in (0.002, 0.008):
        width = np.hypot(own, spread)
        skin += 0.5 * np.exp(-0.5 * (distance / width) ** 2) / (width * np.sqrt(2 * np.pi))
    above = np.maximum(distance, 2e-4)
    cloth = above / mode**2 * np.exp(-above / mode)
    return np.clip(np.log(cloth + 1e-12) - np.log(skin + 1e-12), -4.0, 3.0)


def _spreads(ring: np.ndarray, distance: np.ndarray, count: int) -> Float64[np.ndarray, " R"]:
    """Return 1.4826 times the median absolute deviation in each ring, and the median of that over 13 rings."""
    order = np.argsort(ring, kind="stable")
    pieces = np.split(distance[order], np.cumsum(np.bincount(ring, minlength=count))[:-1])
    own = np.array([1.4826 * np.median(np.abs(one - np.median(one))) if len(one) else np.nan for one in pieces])
    if not np.isfinite(own).any():
        return np.zeros(count)
    # Rings that the scan lacks take the mean of what is known.
    own = np.where(np.isfinite(own), own, np.nanmean(own))
    return np.asarray(median_filter(own, 13, mode="nearest"))
