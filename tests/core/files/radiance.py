"""A writer of Radiance pictures, by their definition: what the reader is held against."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

import numpy as np


def rgbe(picture: np.ndarray) -> np.ndarray:
    """(H, W, 4) bytes of linear light: three mantissas of eight bits and the exponent that they share."""
    largest = picture.max(axis=2)
    mantissa, exponent = np.frexp(largest)
    scale = np.where(largest > 0.0, mantissa * 256.0 / np.maximum(largest, 1e-38), 0.0)
    shared = np.where(largest > 0.0, exponent + 128, 0)
    return np.concatenate([picture * scale[..., None], shared[..., None]], axis=2).astype(np.uint8)


def write_radiance(path: Path, picture: np.ndarray, *, packed: bool = False) -> None:
    """Write a picture, its rows flat or in runs."""
    height, width = picture.shape[:2]
    rows = rgbe(picture)
    data = rows.tobytes() if not packed else b"".join(map(_packed, rows))
    head = b"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1.0\n\n-Y %d +X %d\n" % (height, width)
    path.write_bytes(head + data)


def _packed(row: np.ndarray) -> bytes:
    out = bytes([2, 2, len(row) >> 8, len(row) & 255])
    for channel in row.T:
        for value, group in groupby(channel.tolist()):
            count = len(list(group))
            while count > 2:
                out += bytes([128 + min(count, 127), value])
                count -= min(count, 127)
            if count:
                out += bytes([count, *[value] * count])
    return out
