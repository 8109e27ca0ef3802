"""The door for OpenEXR pictures (.exr), read by the format's own library (extra `exr`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import regular_file

MAGIC = b"\x76\x2f\x31\x01"
_MOST_PIXELS = 1 << 26
_EXPECTED = "an OpenEXR picture with channels R, G and B, or Y, all of one size"


def read_openexr(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Read the first part of an OpenEXR picture, linear light, its first row the uppermost.

    Raises:
        InputError: missing, damaged or foreign; other channels; pixels beside the display; more than 64 million.
        MissingExtraError: no OpenEXR.
    """
    subject, file_path = f"light {path}", str(regular_file(path, subject="light"))
    try:
        import OpenEXR
    except ImportError:
        raise MissingExtraError("OpenEXR", extra="exr", purpose=f"reading {path}") from None
    try:
        with OpenEXR.File(file_path, separate_channels=True, header_only=True) as file:
            height, width = _size(file.header(), subject)
        with OpenEXR.File(file_path, separate_channels=True) as file:
            # The pixels are the library's and go with the file.
            channels = {name: np.array(one.pixels) for name, one in file.channels().items()}
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, OverflowError) as error:
        said = str(error).split("\n")[0][:120]
        raise InputError(subject, expected=_EXPECTED, received=f"a damaged one: {said}") from None
    names = ("R", "G", "B") if "R" in channels else ("Y",) * 3
    found = [channels.get(name) for name in names]
    if any(one is None or one.shape != (height, width) for one in found):
        raise InputError(subject, expected=_EXPECTED, received=f"channels {', '.join(sorted(channels)) or 'none'}")
    return np.stack([one.astype(np.float32) for one in found if one is not None], axis=-1)


def _size(header: dict[str, Any], subject: str) -> tuple[int, int]:
    """Height and width, before any pixel is read."""
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
    shown = [np.asarray(corner, dtype=np.int64) for corner in header["displayWindow"]]
    width, height = (int(side) for side in high - low + 1)
    if width < 1 or height < 1 or width * height > _MOST_PIXELS:
        raise InputError(subject, expected=f"1 to {_MOST_PIXELS} pixels", received=f"{width} x {height}")
    if not (np.array_equal(low, shown[0]) and np.array_equal(high, shown[1])):
        raise InputError(subject, expected=_EXPECTED, received="pixels of a part of the picture, or beyond it")
    return height, width
