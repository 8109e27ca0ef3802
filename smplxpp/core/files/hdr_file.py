"""The door for Radiance pictures (.hdr): light of more range than a screen shows."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes

_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_FORMAT = b"32-bit_rle_rgbe"
MOST_BYTES = 1 << 29
_MOST_PIXELS = 1 << 26
_LONGEST_HEADER = 1 << 16
_RUN = 128
_EXPECTED = "a Radiance picture (.hdr, 32-bit_rle_rgbe, rows from the top)"
_REMEDY = "Blender, GIMP, oiiotool and most viewers of panoramas write .hdr"


def read_radiance(path: str | Path) -> Float32[np.ndarray, "H W 3"]:
    """Read a Radiance picture, linear light, its first row the uppermost.

    Raises:
        InputError: missing, damaged or foreign; another orientation or colour space; more than 64 million pixels.
    """
    subject = f"light {path}"
    data = read_bytes(path, subject="light", most=MOST_BYTES)
    width, height, begin = _header(data, subject)
    if len(data) - begin < 4 * height:
        raise InputError(subject, expected=f"{height} rows of pixels", received=f"{len(data) - begin} bytes of them")
    rows = np.empty((height, width, 4), np.uint8)
    at = begin
    for row in rows:
        at = _row(data, at, row, subject)
    scale = np.ldexp(np.float32(1.0), rows[..., 3].astype(np.int32) - 136)
    return rows[..., :3].astype(np.float32) * np.where(rows[..., 3] > 0, scale, np.float32(0.0))[..., None]


def _header(data: bytes, subject: str) -> tuple[int, int, int]:
    """Width, height, and where the pixels begin."""
    end = data.find(b"\n\n", 0, _LONGEST_HEADER)
    if not data.startswith(_MAGIC) or end < 0:
        raise InputError(subject, expected=_EXPECTED, received="another kind of file", remedy=_REMEDY)
    lines = data[:end].split(b"\n")
    kinds = [line.split(b"=", 1)[1].strip() for line in lines if line.startswith(b"FORMAT=")]
    if kinds and kinds != [_FORMAT]:
        raise InputError(subject, expected=_EXPECTED, received=f"format {kinds[0][:40]!r}", remedy=_REMEDY)
    stop = data.find(b"\n", end + 2, end + 2 + _LONGEST_HEADER)
    size = re.fullmatch(rb"-Y (\d{1,6}) \+X (\d{1,6})", data[end + 2 : max(stop, 0)].strip())
    if size is None:
        line = data[end + 2 : end + 42].split(b"\n")[0]
        raise InputError(subject, expected=f"{_EXPECTED}: -Y height +X width", received=repr(line), remedy=_REMEDY)
    height, width = int(size[1]), int(size[2])
    if not 0 < width * height <= _MOST_PIXELS:
        raise InputError(subject, expected=f"1 to {_MOST_PIXELS} pixels", received=f"{width} x {height}")
    return width, height, stop + 1


def _row(data: bytes, at: int, row: np.ndarray, subject: str) -> int:
    """Decode one row into (W, 4); returns where the next begins."""
    width = len(row)
    head = data[at : at + 4]
    packed = 8 <= width < 1 << 15 and head[:2] == b"\x02\x02" and len(head) == 4
    if not packed:
        flat = data[at : at + 4 * width]
        if len(flat) != 4 * width or head[:3] == b"\x01\x01\x01":
            raise _damaged(subject)
        row[:] = np.frombuffer(flat, np.uint8).reshape(width, 4)
        return at + 4 * width
    if head[2] << 8 | head[3] != width:
        raise _damaged(subject)
    at += 4
    for channel in range(4):
        x = 0
        while x < width:
            if at + 1 >= len(data):
                raise _damaged(subject)
            count = data[at]
            if count > _RUN:  # a run of one value
                count -= _RUN
                piece: bytes | int = data[at + 1]
                at += 2
            else:
                piece = data[at + 1 : at + 1 + count]
                at += 1 + count
            short = not isinstance(piece, int) and len(piece) != count
            if not 0 < count <= width - x or short:
                raise _damaged(subject)
            row[x : x + count, channel] = piece if isinstance(piece, int) else np.frombuffer(piece, np.uint8)
            x += count
    return at


def _damaged(subject: str) -> InputError:
    return InputError(subject, expected="rows that end where the picture does", received="damaged ones, or old runs")
