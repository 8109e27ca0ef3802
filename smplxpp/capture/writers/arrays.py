"""Arrays of a capture, packed as small as np.load can read."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from smplxpp.core.atomic import atomic_path

# Coordinates of truth meshes are rounded to this many metres (0.06 mm): they compress better.
QUANTUM = 2.0**-14


def rounded(vertices: np.ndarray) -> np.ndarray:
    """Coordinates as they are stored: multiples of `QUANTUM`."""
    return np.round(vertices / QUANTUM) * QUANTUM


def save_compact(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """An npz file packed with LZMA, columns stored one after the other: two thirds of deflate; np.load reads it."""
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_LZMA) as archive:
        for name, value in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, np.asfortranarray(value))
            # A fixed date: the same arrays give the same file.
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            archive.writestr(info, buffer.getvalue(), compress_type=zipfile.ZIP_LZMA)
