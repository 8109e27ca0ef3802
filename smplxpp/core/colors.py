"""Colour spaces: sRGB, linear light, and OKLab, in which equal steps look equal.

sRGB: IEC 61966-2-1. OKLab: B. Ottosson, "A perceptual color space for image processing", 2020.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

# Linear sRGB to cone responses, and their cube roots to OKLab (Ottosson's matrices, ten digits as he prints them).
_LMS_FROM_RGB = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB_FROM_LMS = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def decode_srgb(x: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Apply the sRGB transfer function: encoded values in [0, 1] to linear light, in the argument's precision."""
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def encode_srgb(x: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Apply the inverse sRGB transfer function: linear light in [0, 1] to encoded values, in the argument's precision.

    Negative light stays on the linear segment and gives no NaN.
    """
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def linear_from_srgb(
    color: Float[np.ndarray, "*shape"] | UInt8[np.ndarray, "*shape"],
) -> Float32[np.ndarray, "*shape"]:
    """Convert sRGB colours, in [0, 1] or as bytes, to linear light in [0, 1], float32."""
    color = np.asarray(color)
    return _linear_table()[color] if color.dtype == np.uint8 else decode_srgb(color.astype(np.float32))


def srgb_from_linear(color: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Convert linear light in [0, 1] to sRGB colours in [0, 1], float64."""
    return encode_srgb(np.asarray(color, dtype=np.float64))


def srgb8_from_linear(color: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Convert linear light, clipped to [0, 1], to sRGB bytes by a table; exact to half a step from 1/255 up."""
    table = _srgb_table()
    return table[(np.clip(color, 0.0, 1.0) * np.float32(len(table) - 1) + np.float32(0.5)).astype(np.int32)]


@cache
def _linear_table() -> np.ndarray:
    return linear_from_srgb(np.arange(256) / 255.0)


@cache
def _srgb_table() -> np.ndarray:
    # 2^14 entries: in the darkest, steepest part two neighbours differ by a fifth of a byte.
    return np.round(255.0 * encode_srgb(np.linspace(0.0, 1.0, 16384))).astype(np.uint8)


def oklab_from_linear(color: Float[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3"]:
    """Convert linear sRGB to OKLab."""
    return np.cbrt(np.asarray(color, dtype=np.float64) @ _LMS_FROM_RGB.T) @ _LAB_FROM_LMS.T


def linear_from_oklab(lab: Float[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3"]:
    """Convert OKLab to linear sRGB, which leaves [0, 1] for colours outside the gamut."""
    return (np.asarray(lab) @ np.linalg.inv(_LAB_FROM_LMS).T) ** 3 @ np.linalg.inv(_LMS_FROM_RGB).T
