"""Colour maps and palettes, made in OKLab so that equal steps of a value look like equal steps of colour."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float, UInt8

from smplxpp.core import InputError, SkinWeights
from smplxpp.core.colors import linear_from_oklab, linear_from_srgb, oklab_from_linear, srgb8_from_linear

# Anchors from low to high. Every map is monotone in lightness, or symmetric about its middle, and keeps its meaning
# for readers with a colour deficiency.
_ANCHORS: dict[str, tuple[str, ...]] = {
    "weight": ("#e9e8e4", "#c3ddb0", "#6fc09a", "#2f93a5", "#36589f", "#33206b"),
    "error": ("#e9e6df", "#f6d58a", "#f39b4d", "#d9482b", "#8c1432", "#3d0a2b"),
    "signed": ("#08306b", "#2f7ebc", "#a9cee3", "#f1efec", "#f4b28f", "#cb4a3f", "#6b0620"),
}
_MISSING = (110, 110, 118)


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
