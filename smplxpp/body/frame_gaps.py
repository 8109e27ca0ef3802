"""Fill frames that hold no parameters, which files with a row a frame number have where nothing was registered."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core import ARRAY_NAMES, POSE_BLOCKS, GeometryWarning, matrix_from_rotvec, rotvec_from_matrix

_ROTATIONS = frozenset(name for name, _ in POSE_BLOCKS)


def without_gaps(content: Any, *, source: str) -> Any:
    """Return a file of stacked frames whose empty frames are interpolated; those at the ends repeat the nearest one.

    A frame is empty if all its parameters are NaN, as `smplxpp register` writes for frames that it was not asked for.
    Rotations are interpolated on the shortest arc, everything else linearly. Frames with single NaNs stay as they are.

    Args:
        content: arrays by name.
        source: the file, in the warning.

    Warns:
        GeometryWarning: which frames were filled.

    Example:
        >>> rows = {name: np.full((3, 3), np.nan) for name in ("global_orient", "transl")}
        >>> rows["transl"][[0, 2]], rows["global_orient"][[0, 2]] = [[0.0], [0.2]], 0.0
        >>> with warnings.catch_warnings(action="ignore"):
        ...     without_gaps(rows, source="file motion.npz")["transl"][1].tolist()
        [0.1, 0.1, 0.1]
    """
    if not isinstance(content, Mapping) or "transl" not in content:
        return content
    arrays = {
        name: np.asarray(content[name])
        for name in ARRAY_NAMES
        if name in content and isinstance(content[name], np.ndarray) and content[name].dtype.kind == "f"
    }
    count = len(arrays["transl"]) if "transl" in arrays else 0
    arrays = {name: rows for name, rows in arrays.items() if rows.ndim > 1 and len(rows) == count}
    if count < 2 or len(arrays) < 2:
        return content
    empty = np.logical_and.reduce(
        [np.isnan(rows.reshape(count, -1)).all(axis=1) for rows in arrays.values() if rows.size]
    )
    known = np.flatnonzero(~empty)
    if not empty.any() or not len(known):
        return content
    gaps = np.flatnonzero(empty)
    # Frames that a warning names.
    named = 6
    shown = ", ".join(map(str, gaps[:named])) + (f" and {len(gaps) - named} more" if len(gaps) > named else "")
    warnings.warn(
        f"{source}: {len(gaps)} of {count} frames hold nothing ({shown}): filled from the frames around them",
        GeometryWarning,
        stacklevel=4,
    )
    # Neighbours of each gap among the known frames, and how far it is from the first to the second.
    after = np.minimum(np.searchsorted(known, gaps), len(known) - 1)
    before = np.maximum(np.searchsorted(known, gaps) - 1, 0)
    first, second = known[before], known[after]
    share = np.where(second > first, (gaps - first) / np.maximum(second - first, 1), 0.0)
    # Before the first known frame both neighbours are this frame.
    first = np.where(gaps < known[0], known[0], first)
    filled = dict(content)
    for name, rows in arrays.items():
        filled[name] = rows.copy()
        filled[name][gaps] = _between(rows, first, second, share, turns=name in _ROTATIONS)
    return filled


def _between(
    rows: np.ndarray,
    first: Int64[np.ndarray, " G"],
    second: Int64[np.ndarray, " G"],
    share: Float64[np.ndarray, " G"],
    *,
    turns: bool,
) -> np.ndarray:
    """Interpolate between pairs of rows by a share of each; rotation vectors along the shortest arc."""
    a, b = rows[first].astype(np.float64), rows[second].astype(np.float64)
    weight = share.reshape(-1, *(1,) * (rows.ndim - 1))
    if not turns:
        return a + weight * (b - a)
    start, end = (matrix_from_rotvec(values.reshape(len(values), -1, 3)) for values in (a, b))
    arc = rotvec_from_matrix(start.swapaxes(-1, -2) @ end)
    between = start @ matrix_from_rotvec(share[:, None, None] * arc)
    return rotvec_from_matrix(between).reshape(a.shape)
