"""Define the interface of keypoint detectors: an image goes in, people with named points come out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from smplxpp.core.errors import one_line

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels, the outer edges of what it holds."""

RELIABLE = 0.5
"""Confidence from which a point is evidence of a person."""


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """Points of one person in one image.

    Attributes:
        points: pixels, centres at +0.5, in the order of the detector's names; 0 where the confidence is 0.
        confidence: from 0 (not there) to 1.
    """

    points: Float64[np.ndarray, "K 2"]
    confidence: Float64[np.ndarray, " K"]

    __repr__ = one_line

    @property
    def total_confidence(self) -> float:
        """The sum of the confidences, which chooses among several people."""
        return float(self.confidence.sum())

    @property
    def box(self) -> Box:
        """The box around the reliable points, or around all points if none is reliable."""
        reliable = self.confidence >= RELIABLE
        own = self.points[reliable if reliable.any() else slice(None)]
        return (*own.min(axis=0).tolist(), *own.max(axis=0).tolist())


class Detector(Protocol):
    """A detector of people with named points.

    Attributes:
        names: of the points, in the vocabulary of `smplxpp.core.keypoints`.
        identity: text that differs whenever the points may differ: program, version, weights and settings.
    """

    names: tuple[str, ...]
    identity: str

    def __call__(self, image: UInt8[np.ndarray, "H W 3"], box: Box | None = None) -> list[DetectedPerson]:
        """Return the people in an image, most confident first.

        Args:
            image: sRGB.
            box: where the person is, if that is known; None for the whole image.
        """
        ...


def mask_box(mask: UInt8[np.ndarray, "H W"]) -> Box | None:
    """Return the box around the person in a mask; None if the mask is empty."""
    rows, columns = (np.flatnonzero((mask > 127).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


def grown(box: Box, share: float, size: tuple[int, int]) -> Box:
    """Enlarge a box by `share` of its longer side at each side, within an image of this width and height."""
    x0, y0, x1, y1 = box
    more = share * max(x1 - x0, y1 - y0)
    return max(x0 - more, 0.0), max(y0 - more, 0.0), min(x1 + more, float(size[0])), min(y1 + more, float(size[1]))


def inside(points: Float64[np.ndarray, "K 2"], size: tuple[int, int]) -> Bool[np.ndarray, " K"]:
    """Return which points lie in an image of this width and height."""
    within = (points >= 0) & (points <= np.array(size, dtype=np.float64))
    return within[:, 0] & within[:, 1]


def most_confident_first(people: Sequence[DetectedPerson]) -> list[DetectedPerson]:
    """Sort people by their total confidence, in descending order."""
    return sorted(people, key=lambda one: -one.total_confidence)
