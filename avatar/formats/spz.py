"""Splats as SPZ, Niantic's packed format: version 3, a gzip stream of whole numbers."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from avatar.formats.splats import Splats
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes

_MAGIC, _VERSION = 0x5053474E, 3
# A coordinate is a whole number of 24 bits, of which so many stand behind the point: 1/65536 m is 0.015 mm.
_FINEST, _BITS = 16, 24
_COLOR = 0.15
_MOST = 10_000_000  # splats that readers of the format take


def write_splat_spz(path: str | Path, splats: Splats) -> None:
    """Write splats as SPZ, whole or not at all; the same splats give the same bytes.

    Kept: positions in steps of 0.015 mm (coarser beyond 128 m), opacity and colour in 8 bits, scales in steps of 6 %
    (from 0.045 mm up), rotations in three numbers of 10 bits, harmonics of degree 1 and up in steps of 1/128. Normals
    are left out. The axes of the format are ours: right, up, backwards.

    Raises:
        InputError: more splats than the format has, or places beyond 8 million metres.
    """
    if len(splats) > _MOST:
        raise InputError(f"splats for {path}", expected=f"at most {_MOST:,}", received=f"{len(splats):,}")
    farthest = float(np.abs(splats.means).max(initial=0.0))
    behind = _FINEST
    while farthest * 2.0**behind >= 2.0 ** (_BITS - 1) and behind > 0:
        behind -= 1
    if farthest * 2.0**behind >= 2.0 ** (_BITS - 1):
        raise InputError(f"splats for {path}", expected="places within 8,000 km", received=f"{farthest:g} m")
    places = np.rint(splats.means.astype(np.float64) * 2.0**behind).astype("<i4")
    pieces = (
        places.reshape(-1, 1).view(np.uint8)[:, :3],
        _byte(splats.opacities * 255.0),
        _byte(splats.f_dc * (_COLOR * 255.0) + 127.5),
        _byte((splats.log_scales + 10.0) * 16.0),
        _smallest_three(splats.unit_quats),
        _byte(splats.f_rest * 128.0 + 128.0),
    )
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(splats), splats.degree, behind, 0, 0)
    atomic_write_bytes(path, gzip.compress(b"".join((header, *(piece.tobytes() for piece in pieces))), mtime=0))


def _byte(values: Float[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N"]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _smallest_three(wxyz: Float32[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Pack rotations: which of x, y, z, w is the largest in two bits, the others' signs and sizes in ten each."""
    quats = np.roll(wxyz, -1, axis=1).astype(np.float64)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32) << 30
    # The others stand from the low bits up in falling order.
    shift = np.zeros(len(quats), np.uint32)
    for axis in range(3, -1, -1):
        kept = largest != axis
        size = np.minimum(np.rint(np.abs(quats[:, axis]) * (511.0 * 2.0**0.5)), 511.0).astype(np.uint32)
        number = size | ((quats[:, axis] < 0).astype(np.uint32) << 9)
        packed |= np.where(kept, number << shift, 0).astype(np.uint32)
        shift += np.where(kept, 10, 0).astype(np.uint32)
    return packed.astype("<u4").reshape(-1, 1).view(np.uint8)
