"""Write images of a capture: JPEG, 8-bit masks and labels, 16-bit normals."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import Image

from smplxpp.core.files.atomic import atomic_write_bytes

# For each kind of file its folder, and the tag before the frame number in file names.
VIEW_FOLDERS = {
    "image": ("rgbs", "rgb"),
    "mask": ("masks", "mask"),
    "label": ("labels", "label"),
    "normal": ("normals", "normal"),
}
JPEG_SUFFIXES = (".jpg", ".jpeg")


def view_path(root: Path, kind: str, camera: str, frame: int, suffix: str) -> Path:
    """Return the path of a view's file: `kind` is a key of `VIEW_FOLDERS`, `suffix` starts with a dot."""
    folder, tag = VIEW_FOLDERS[kind]
    return root / folder / camera / f"{camera}_{tag}{frame:06d}{suffix}"


def write_jpeg(path: Path, image: UInt8[np.ndarray, "H W 3"], *, quality: int) -> None:
    """Write an sRGB image as an optimised JPEG file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_gray_png(path: Path, image: UInt8[np.ndarray, "H W"]) -> None:
    """Write a mask or labels as an 8-bit PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_normal_png(path: Path, normals: Float[np.ndarray, "H W 3"]) -> None:
    """Write unit normals as 16-bit RGB, n = value / 65535 * 2 - 1; zero rows (background) become 0, 0, 0."""
    # 12 bits of 16 are kept, because the others are noise that does not compress.
    step = 16
    value = np.round((normals + 1.0) * (0.5 * 65535 / step)) * step
    value = np.where((normals == 0.0).all(axis=2, keepdims=True), 0, np.clip(value, step, 65535))
    atomic_write_bytes(path, png16(value.astype(np.uint16)))


def normal_codes(normals: Float[np.ndarray, "H W 3"]) -> UInt16[np.ndarray, "H W 3"]:
    """Encode unit normals with all 16 bits, n = value / 65535 * 2 - 1; zero rows (background) become 0, 0, 0."""
    codes = np.clip(np.round((normals + 1.0) * 32767.5), 1, 65535)
    return np.where(normals.any(axis=2, keepdims=True), codes, 0).astype(np.uint16)


def encoded_image(image: UInt8[np.ndarray, "H W *D"] | UInt16[np.ndarray, "H W 3"], suffix: str, quality: int) -> bytes:
    """Return the bytes of an image file: JPEG without chroma subsampling by its suffixes, else PNG of 8 or 16 bits."""
    if image.dtype == np.uint16:
        return png16(image)
    buffer = io.BytesIO()
    if suffix in JPEG_SUFFIXES:
        Image.fromarray(image).save(buffer, "JPEG", quality=quality, subsampling=0)
    else:
        Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def png16(image: UInt16[np.ndarray, "H W 3"]) -> bytes:
    """Return the bytes of a 16-bit RGB PNG, which Pillow cannot write; all rows use the `Up` filter."""
    height, width = image.shape[:2]
    rows = np.ascontiguousarray(image.astype(">u2")).view(np.uint8).reshape(height, -1)
    # Filter type 2 (Up) stores each byte minus the one above it modulo 256, with zeros above the first row.
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = 2
    filtered[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))

    def chunk(kind: bytes, data: bytes) -> bytes:
        # Length, type, data, and the CRC of type and data (PNG specification, section 5.3).
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    # Bit depth 16 and colour type 2 (RGB); no interlacing.
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(filtered.tobytes(), 9)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
