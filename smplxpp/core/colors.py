"""Colour spaces: sRGB, linear light, and OKLab, in which equal steps look equal.

OKLab: B. Ottosson, "A perceptual color space for image processing", 2020.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

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


def linear_from_srgb(
    color: Float[np.ndarray, "*shape"] | UInt8[np.ndarray, "*shape"],
) -> Float32[np.ndarray, "*shape"]:
    """Turn sRGB values in 0..1 (bytes in 0..255) into linear light in 0..1 (IEC 61966-2-1)."""
    color = np.asarray(color)
    if color.dtype == np.uint8:
        return _linear_table()[color]
    x = color.astype(np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def srgb8_from_linear(color: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Turn linear light, clipped to 0..1, into sRGB; exact to half a step from 1/255 up."""
    table = _srgb_table()
    return table[(np.clip(color, 0.0, 1.0) * np.float32(len(table) - 1) + np.float32(0.5)).astype(np.int32)]


def srgb_from_linear(color: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Turn linear light in 0..1 into sRGB values in 0..1."""
    x = np.asarray(color, dtype=np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


@cache
def _linear_table() -> np.ndarray:
    return linear_from_srgb(np.arange(256) / 255.0)


@cache
def _srgb_table() -> np.ndarray:
    x = np.linspace(0.0, 1.0, 16384)
    y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.round(255.0 * y).astype(np.uint8)


def oklab_from_linear(color: Float[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3"]:
    """Turn linear sRGB into OKLab."""
    return np.cbrt(np.asarray(color, dtype=np.float64) @ _LMS_FROM_RGB.T) @ _LAB_FROM_LMS.T


def linear_from_oklab(lab: Float[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3"]:
    """Turn OKLab into linear sRGB, which may leave 0..1."""
    return (np.asarray(lab) @ np.linalg.inv(_LAB_FROM_LMS).T) ** 3 @ np.linalg.inv(_LMS_FROM_RGB).T
