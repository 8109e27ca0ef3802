"""What every detector of keypoints is: an image goes in, the people in it come out with named points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float64, UInt8

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels, the outer edges of what it holds."""

# Confidence from which a point says that somebody is there.
SURE = 0.5


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """Points of one person in one image.

    Attributes:
        points: pixels, centres at +0.5, in the order of the detector's names; 0 where the confidence is.
        confidence: from 0 (not there) to 1.
    """

    points: Float64[np.ndarray, "K 2"]
    confidence: Float64[np.ndarray, " K"]

    @property
    def certainty(self) -> float:
        """The sum of the confidences: who is surest is taken where one person is wanted."""
        return float(self.confidence.sum())

    @property
    def box(self) -> Box:
        """About the points that are sure, or about all where none is."""
        sure = self.confidence >= SURE
        own = self.points[sure if sure.any() else slice(None)]
        return (*own.min(axis=0).tolist(), *own.max(axis=0).tolist())


class Detector(Protocol):
    """Finds people.

    Attributes:
        names: of the points, in the vocabulary of `smplxpp.core.keypoints`.
        identity: tells apart whatever gives other points: the program, its version, the weights, the settings.
    """

    names: tuple[str, ...]
    identity: str

    def __call__(self, image: UInt8[np.ndarray, "H W 3"], box: Box | None = None) -> list[DetectedPerson]:
        """The people in an sRGB image, the surest first; none where nobody is.

        Args:
            image: sRGB.
            box: where the person is looked for, if that is known; None: in the whole image.
        """
        ...


def mask_box(mask: UInt8[np.ndarray, "H W"]) -> Box | None:
    """The box about what a mask calls the person, None where that is nothing."""
    rows, columns = (np.flatnonzero((mask > 127).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


def grown(box: Box, share: float, size: tuple[int, int]) -> Box:
    """The box with `share` of its longer side added at each side, within an image of this width and height."""
    x0, y0, x1, y1 = box
    more = share * max(x1 - x0, y1 - y0)
    return max(x0 - more, 0.0), max(y0 - more, 0.0), min(x1 + more, float(size[0])), min(y1 + more, float(size[1]))


def inside(points: Float64[np.ndarray, "K 2"], size: tuple[int, int]) -> Bool[np.ndarray, " K"]:
    """Which points lie within an image of this width and height."""
    within = (points >= 0) & (points <= np.array(size, dtype=np.float64))
    return within[:, 0] & within[:, 1]


def surest_first(people: Sequence[DetectedPerson]) -> list[DetectedPerson]:
    """The people by their certainty."""
    return sorted(people, key=lambda one: -one.certainty)
