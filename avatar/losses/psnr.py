"""Peak signal-to-noise ratio: the one formula behind every figure and log in decibels."""

from __future__ import annotations

import math

SMALLEST = 1e-12
"""Mean square errors below this count as this, so that equal images have 120 dB and means over images stay finite."""


def psnr_from_mse(mean_square: float) -> float:
    """Return `-10 log10(mean square error)` of images in [0, 1], in dB and at most 120."""
    return -10.0 * math.log10(max(mean_square, SMALLEST))
