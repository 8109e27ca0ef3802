"""Images of a capture: JPEG, 8-bit masks and labels, 16-bit normals."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import Image

from smplxpp.core.atomic import atomic_write_bytes

# Components of normals keep 12 bits of 16: the rest would be noise that does not compress.
_NORMAL_STEP = 16


def write_jpeg(path: Path, image: UInt8[np.ndarray, "H W 3"], *, quality: int) -> None:
    """Write an sRGB image."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_gray_png(path: Path, image: UInt8[np.ndarray, "H W"]) -> None:
    """Write a mask or a label map."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_normal_png(path: Path, normals: Float[np.ndarray, "H W 3"]) -> None:
    """Write unit normals as 16-bit RGB, n = value / 65535 * 2 - 1; zero rows (background) become 0, 0, 0."""
    value = np.round((normals + 1.0) * (0.5 * 65535 / _NORMAL_STEP)) * _NORMAL_STEP
    value = np.where((normals == 0.0).all(axis=2, keepdims=True), 0, np.clip(value, _NORMAL_STEP, 65535))
    atomic_write_bytes(path, png16(value.astype(np.uint16)))


def png16(image: UInt16[np.ndarray, "H W 3"]) -> bytes:
    """Encode a 16-bit RGB PNG (Pillow writes none); every row has the `Up` filter."""
    height, width = image.shape[:2]
    rows = np.ascontiguousarray(image.astype(">u2")).view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = 2
    filtered[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(filtered.tobytes(), 9)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
