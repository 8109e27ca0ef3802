"""Colour maps and palettes, made in OKLab so that equal steps of a value look like equal steps of colour.

OKLab: B. Ottosson, "A perceptual color space for image processing", 2020.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.skin_weights import SkinWeights

# Anchors from low to high. Every map is monotone in lightness, or symmetric about its middle, and keeps its meaning
# for readers with a colour deficiency.
_ANCHORS: dict[str, tuple[str, ...]] = {
    "weight": ("#e9e8e4", "#c3ddb0", "#6fc09a", "#2f93a5", "#36589f", "#33206b"),
    "error": ("#e9e6df", "#f6d58a", "#f39b4d", "#d9482b", "#8c1432", "#3d0a2b"),
    "signed": ("#08306b", "#2f7ebc", "#a9cee3", "#f1efec", "#f4b28f", "#cb4a3f", "#6b0620"),
}
_MISSING = (110, 110, 118)

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


@cache
def colormap(name: str) -> UInt8[np.ndarray, "256 3"]:
    """Return the colours of "weight" (pale to violet), "error" (pale to dark) or "signed" (blue, pale, red)."""
    if name not in _ANCHORS:
        raise InputError("colour map", expected=f"one of {', '.join(_ANCHORS)}", received=repr(name))
    anchors = np.array([[int(code[i : i + 2], 16) for i in (1, 3, 5)] for code in _ANCHORS[name]], dtype=np.uint8)
    lab = oklab_from_linear(linear_from_srgb(anchors))
    # Anchors are spread by their distance in OKLab, which makes the map's steps even. A signed map keeps its middle.
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lab, axis=0), axis=1))])
    at = length / length[-1]
    if name == "signed":
        middle = len(at) // 2
        upper = 0.5 + 0.5 * (at[middle + 1 :] - at[middle]) / (1.0 - at[middle])
        at = np.concatenate([0.5 * at[: middle + 1] / at[middle], upper])
    x = np.linspace(0.0, 1.0, 256)
    table = srgb8_from_linear(linear_from_oklab(np.stack([np.interp(x, at, channel) for channel in lab.T], axis=1)))
    table.setflags(write=False)
    return table


def heat_colors(values: Float[np.ndarray, " N"], *, cmap: str, limits: tuple[float, float]) -> UInt8[np.ndarray, "N 3"]:
    """Colour values, clipped to `limits`; grey where they are not finite."""
    low, high = limits
    if not high > low:
        raise InputError("limits of the colour map", expected="low < high", received=f"{low}, {high}")
    values = np.asarray(values, dtype=np.float64)
    known = np.isfinite(values)
    index = np.clip((np.where(known, values, low) - low) / (high - low), 0.0, 1.0) * 255.0
    colors = colormap(cmap)[np.round(index).astype(np.int64)]
    colors[~known] = _MISSING
    return colors


@cache
def joint_palette(count: int) -> UInt8[np.ndarray, "J 3"]:
    """Return `count` colours in which neighbours in the list, and so mostly in the skeleton, look different."""
    k = np.arange(count)
    # The golden angle never repeats a hue; three lightness levels separate the hues that come near each other.
    hue = 2.0 * np.pi * ((0.08 + k * 0.61803398875) % 1.0)
    lightness = np.array([0.72, 0.58, 0.84])[k % 3]
    chroma = np.array([0.13, 0.13, 0.10])[k % 3]
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=1)
    table = srgb8_from_linear(linear_from_oklab(lab))
    table.setflags(write=False)
    return table


def blend_joint_colors(weights: SkinWeights | Float[np.ndarray, "N J"]) -> UInt8[np.ndarray, "N 3"]:
    """Mix the joints' colours by skinning weights, sparse or dense."""
    if isinstance(weights, SkinWeights):
        palette = linear_from_srgb(joint_palette(weights.joint_count))
        mixed = np.einsum("nk,nkd->nd", weights.joint_weights, palette[weights.joint_indices])
    else:
        weights = np.asarray(weights)
        mixed = weights @ linear_from_srgb(joint_palette(weights.shape[1]))
    return srgb8_from_linear(mixed)
