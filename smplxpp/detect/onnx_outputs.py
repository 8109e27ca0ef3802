"""Points out of what keypoint models give: simcc's two rows of bins a point, or a heatmap a point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.core.errors import InputError

_FLOOR = 1e-6


def points_of(
    outputs: Sequence[Any],
    size: tuple[int, int],
    *,
    simcc_split: float | None = None,
    alignment: str = "stride",
    subject: str = "keypoint model",
) -> Float64[np.ndarray, "K 3"]:
    """Points in pixels of the model's input, centres at whole numbers, and confidences cut to [0, 1].

    Two outputs of shape (1, K, bins) are simcc's x and y (Li et al. 2022); one of shape (1, K, h, w) is heatmaps. Simcc
    scores are the smaller of the two maxima, as mmpose's.

    Args:
        size: width and height of the model's input.
        simcc_split: bins a pixel; None: the bins' number over the size.
        alignment: see `ModelCard`.

    Raises:
        InputError: outputs of another kind, or values that are not finite.
    """
    arrays = [np.asarray(one) for one in outputs if isinstance(one, np.ndarray) and one.dtype.kind == "f"]
    rows = [one for one in arrays if one.ndim == 3 and one.shape[0] == 1]
    maps = [one for one in arrays if one.ndim == 4 and one.shape[0] == 1]
    pair = _simcc_pair(rows, size, simcc_split)
    if pair is not None:
        finite(pair, subject)
        return _from_simcc(pair[0][0], pair[1][0], size, simcc_split)
    if maps:
        finite(maps[:1], subject)
        return _from_heatmaps(maps[0][0], size, alignment)
    raise InputError(
        subject,
        expected="two outputs (1, K, bins) of simcc with bins in proportion to the input, or heatmaps (1, K, h, w)",
        received=f"{[tuple(np.shape(one)) for one in outputs]}"[:300],
    )


def finite(arrays: Sequence[np.ndarray], subject: str) -> None:
    """Refuse NaN and infinity."""
    if not all(np.isfinite(one).all() for one in arrays):
        raise InputError(subject, expected="finite outputs", received="NaN or infinity")


def _simcc_pair(
    rows: Sequence[np.ndarray], size: tuple[int, int], split: float | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """The outputs of x and y: as many points, and bins in the proportion of the input's sides."""
    for first in rows:
        for second in rows:
            if first is second or first.shape[1] != second.shape[1]:
                continue
            bins_x, bins_y = first.shape[2], second.shape[2]
            splits = bins_x / size[0], bins_y / size[1]
            if abs(splits[0] - splits[1]) < 0.02 * splits[0] and (
                split is None or abs(splits[0] - split) < 0.02 * split
            ):
                return first, second
    return None


def _from_simcc(
    x: Float[np.ndarray, "K X"], y: Float[np.ndarray, "K Y"], size: tuple[int, int], split: float | None
) -> Float64[np.ndarray, "K 3"]:
    split = split or x.shape[1] / size[0]
    u, v = (_peak(one.astype(np.float64)) / split for one in (x, y))
    score = np.minimum(x.max(axis=1), y.max(axis=1)).astype(np.float64)
    return np.column_stack([u, v, np.clip(score, 0.0, 1.0)])


def _from_heatmaps(
    maps: Float[np.ndarray, "K h w"], size: tuple[int, int], alignment: str
) -> Float64[np.ndarray, "K 3"]:
    count, height, width = maps.shape
    flat = maps.reshape(count, -1).astype(np.float64)
    row, column = np.divmod(flat.argmax(axis=1), width)
    values = maps.astype(np.float64)
    u = _peak(values[np.arange(count), row, :])
    v = _peak(values[np.arange(count), :, column])
    if alignment == "corners":
        scale = (size[0] - 1) / max(width - 1, 1), (size[1] - 1) / max(height - 1, 1)
    else:
        scale = size[0] / width, size[1] / height
    return np.column_stack([u * scale[0], v * scale[1], np.clip(flat.max(axis=1), 0.0, 1.0)])


def _peak(rows: Float64[np.ndarray, "K N"]) -> Float64[np.ndarray, " K"]:
    """Where each row is highest, between its cells: the top of the parabola through the logarithms of three, which is
    exact for a Gaussian."""
    at = rows.argmax(axis=1)
    count, width = rows.shape
    inner = (at > 0) & (at < width - 1)
    middle = np.clip(at, 1, max(width - 2, 1))
    if width < 3:
        return at.astype(np.float64)
    three = np.log(np.maximum(np.stack([rows[np.arange(count), middle + k] for k in (-1, 0, 1)]), _FLOOR))
    bend = three[0] - 2.0 * three[1] + three[2]
    shift = np.where(bend < -_FLOOR, 0.5 * (three[0] - three[2]) / np.minimum(bend, -_FLOOR), 0.0)
    return at + np.where(inner, np.clip(shift, -0.5, 0.5), 0.0)
