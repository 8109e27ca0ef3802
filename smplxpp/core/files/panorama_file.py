"""Panoramas from files: Radiance (.hdr) or OpenEXR (.exr), told by their first bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from smplxpp.core.files.exr_file import MAGIC, read_openexr
from smplxpp.core.files.hdr_file import MOST_BYTES, read_radiance
from smplxpp.core.files.paths import read_bytes


def read_panorama(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Read a picture of light, linear, its first row the uppermost.

    Raises:
        InputError: what `read_radiance` and `read_openexr` refuse.
        MissingExtraError: an OpenEXR picture and no OpenEXR.
    """
    data = read_bytes(path, subject="light", most=MOST_BYTES)
    return read_openexr(path) if data.startswith(MAGIC) else read_radiance(path)
