"""Read panoramas in linear light: Radiance (.hdr) and OpenEXR (.exr, extra `exr`), recognised by their first bytes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes, regular_file
from smplxpp.core.lazy import import_extra

# Bounds of both formats: a file of half a GiB, and a picture of 8192 x 8192 pixels (805 MB as float32).
_MAX_BYTES, _MAX_PIXELS = 1 << 29, 1 << 26
_RADIANCE = "a Radiance picture (.hdr, 32-bit_rle_rgbe, rows from the top)"
_OPENEXR = "an OpenEXR picture with channels R, G and B, or Y, all of one size"


def read_panorama(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Read a picture in linear light; its first row is the top row.

    Raises:
        InputError: what `read_radiance` and `read_openexr` refuse.
        MissingExtraError: an OpenEXR picture, and the library OpenEXR is not installed.
    """
    data = read_bytes(path, subject="light", most=_MAX_BYTES)
    return read_openexr(path) if data.startswith(b"\x76\x2f\x31\x01") else read_radiance(path)


def read_radiance(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Read a Radiance picture in linear light; its first row is the top row.

    A pixel is stored as RGBE, three mantissas and a common exponent: `channel = mantissa * 2^(E - 136)`.

    Raises:
        InputError: missing, damaged or foreign file; another orientation or colour space; more than 64 million pixels.
    """
    subject = f"light {path}"
    data = read_bytes(path, subject="light", most=_MAX_BYTES)
    width, height, begin = _radiance_header(data, subject)
    # The shortest encoding of a row has four bytes, so that a short file is refused before memory is allocated.
    if len(data) - begin < 4 * height:
        raise InputError(subject, expected=f"{height} rows of pixels", received=f"{len(data) - begin} bytes of them")
    rows = np.empty((height, width, 4), np.uint8)
    at = begin
    for row in rows:
        at = _decode_row(data, at, row, subject)
    # The bias of 136 is 128 of the exponent and 8 of the mantissa's bits. An exponent of 0 is black, whatever the
    # mantissas.
    scale = np.ldexp(np.float32(1.0), rows[..., 3].astype(np.int32) - 136)
    return rows[..., :3].astype(np.float32) * np.where(rows[..., 3] > 0, scale, np.float32(0.0))[..., None]


def _radiance_header(data: bytes, subject: str) -> tuple[int, int, int]:
    """Return width, height, and the place of the first pixel."""
    longest_header = 1 << 16
    remedy = "Blender, GIMP, oiiotool and most viewers of panoramas write .hdr"
    # The header ends with an empty line, after which one line gives the size.
    end = data.find(b"\n\n", 0, longest_header)
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")) or end < 0:
        raise InputError(subject, expected=_RADIANCE, received="another kind of file", remedy=remedy)
    lines = data[:end].split(b"\n")
    kinds = [line.split(b"=", 1)[1].strip() for line in lines if line.startswith(b"FORMAT=")]
    if kinds and kinds != [b"32-bit_rle_rgbe"]:
        raise InputError(subject, expected=_RADIANCE, received=f"format {kinds[0][:40]!r}", remedy=remedy)
    stop = data.find(b"\n", end + 2, end + 2 + longest_header)
    # "-Y height +X width": rows from the top, columns from the left; the seven other orders are rare and refused.
    size = re.fullmatch(rb"-Y (\d{1,6}) \+X (\d{1,6})", data[end + 2 : max(stop, 0)].strip())
    if size is None:
        line = data[end + 2 : end + 42].split(b"\n")[0]
        raise InputError(subject, expected=f"{_RADIANCE}: -Y height +X width", received=repr(line), remedy=remedy)
    height, width = int(size[1]), int(size[2])
    if not 0 < width * height <= _MAX_PIXELS:
        raise InputError(subject, expected=f"1 to {_MAX_PIXELS} pixels", received=f"{width} x {height}")
    return width, height, stop + 1


def _decode_row(data: bytes, at: int, row: np.ndarray, subject: str) -> int:
    """Decode one row of pixels into `row` (W, 4), and return the place of the next row."""
    width = len(row)
    head = data[at : at + 4]
    # Run-length encoding is marked by 2, 2 and the width. Rows without the mark are plain RGBE pixels.
    if not (8 <= width < 1 << 15 and head[:2] == b"\x02\x02" and len(head) == 4):
        # Pixels 1, 1, 1 mark repetitions in the old run-length encoding, which is not supported.
        flat = data[at : at + 4 * width]
        if len(flat) != 4 * width or head[:3] == b"\x01\x01\x01":
            raise _damaged_row(subject)
        row[:] = np.frombuffer(flat, np.uint8).reshape(width, 4)
        return at + 4 * width
    if head[2] << 8 | head[3] != width:
        raise _damaged_row(subject)
    at += 4
    # The four channels follow each other. A count above 128 repeats one byte, a smaller one copies as many bytes.
    for channel in range(4):
        x = 0
        while x < width:
            if at + 1 >= len(data):
                raise _damaged_row(subject)
            count = data[at]
            if count > 128:
                count -= 128
                piece: bytes | int = data[at + 1]
                at += 2
            else:
                piece = data[at + 1 : at + 1 + count]
                at += 1 + count
            short = not isinstance(piece, int) and len(piece) != count
            if not 0 < count <= width - x or short:
                raise _damaged_row(subject)
            row[x : x + count, channel] = piece if isinstance(piece, int) else np.frombuffer(piece, np.uint8)
            x += count
    return at


def _damaged_row(subject: str) -> InputError:
    return InputError(subject, expected="rows that end where the picture does", received="damaged ones, or old runs")


def read_openexr(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Read the first part of an OpenEXR picture in linear light; its first row is the top row.

    Raises:
        InputError: missing, damaged or foreign file; other channels; a data window that is not the display window; more
            than 64 million pixels.
        MissingExtraError: the library OpenEXR is not installed.
    """
    subject, file_path = f"light {path}", str(regular_file(path, subject="light"))
    OpenEXR = import_extra("OpenEXR", extra="exr", purpose=f"reading {path}")
    try:
        # The header alone first, so that a large picture is refused before its pixels are decoded.
        with OpenEXR.File(file_path, separate_channels=True, header_only=True) as file:
            height, width = _openexr_size(file.header(), subject)
        with OpenEXR.File(file_path, separate_channels=True) as file:
            # Copied, because the library frees the pixels with the file.
            channels = {name: np.array(one.pixels) for name, one in file.channels().items()}
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, OverflowError) as error:
        reason = str(error).split("\n")[0][:120]
        raise InputError(subject, expected=_OPENEXR, received=f"a damaged one: {reason}") from None
    # A picture of luminance alone becomes grey.
    names = ("R", "G", "B") if "R" in channels else ("Y",) * 3
    found = [channels.get(name) for name in names]
    if any(one is None or one.shape != (height, width) for one in found):
        raise InputError(subject, expected=_OPENEXR, received=f"channels {', '.join(sorted(channels)) or 'none'}")
    return np.stack([one.astype(np.float32) for one in found if one is not None], axis=-1)


def _openexr_size(header: dict[str, Any], subject: str) -> tuple[int, int]:
    """Return height and width of the data window, which must be the display window."""
    # Corners of both windows are inclusive.
    low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
    display = [np.asarray(corner, dtype=np.int64) for corner in header["displayWindow"]]
    width, height = (int(side) for side in high - low + 1)
    if width < 1 or height < 1 or width * height > _MAX_PIXELS:
        raise InputError(subject, expected=f"1 to {_MAX_PIXELS} pixels", received=f"{width} x {height}")
    if not (np.array_equal(low, display[0]) and np.array_equal(high, display[1])):
        raise InputError(subject, expected=_OPENEXR, received="pixels of a part of the picture, or outside of it")
    return height, width
