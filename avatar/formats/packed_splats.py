"""Write splats in packed formats: SPZ of Niantic and SOG of PlayCanvas."""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.spatial import cKDTree

from avatar.formats.splats import Splats
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.package_file import write_package

# --- SPZ ------------------------------------------------------------------------------------------------------------


def write_splat_spz(path: str | Path, splats: Splats) -> None:
    """Write splats as SPZ version 3, a gzip stream of integers; the same splats give the same bytes.

    A failed write leaves no file.

    Kept: positions in steps of 0.015 mm (coarser outside of 128 m), opacity and colour in 8 bits, scales in steps of
    6 % (from 0.045 mm up), rotations in three numbers of 10 bits, harmonics of degree 1 and up in steps of 1/128.
    Normals are left out. The axes of the format are ours: right, up, backwards.

    Raises:
        InputError: more than 10 million splats, the limit of the format's readers, or positions outside of 8,000 km.
    """
    magic, version, max_splats = 0x5053474E, 3, 10_000_000
    if len(splats) > max_splats:
        raise InputError(f"splats for {path}", expected=f"at most {max_splats:,}", received=f"{len(splats):,}")
    farthest = float(np.abs(splats.means).max(initial=0.0))
    # A coordinate is a signed fixed-point number of 24 bits, with at most 16 of them after the point (0.015 mm).
    fraction_bits, bits = 16, 24
    while farthest * 2.0**fraction_bits >= 2.0 ** (bits - 1) and fraction_bits > 0:
        fraction_bits -= 1
    if farthest * 2.0**fraction_bits >= 2.0 ** (bits - 1):
        raise InputError(f"splats for {path}", expected="positions within 8,000 km", received=f"{farthest:g} m")
    # Little-endian 32-bit integers, of which the three low bytes are kept.
    positions = np.rint(splats.means.astype(np.float64) * 2.0**fraction_bits).astype("<i4")
    # Scales and offsets are the format's: opacity 0..255, colour 0.15 a unit around 1/2, log scales of 1/16 from -10
    # up, harmonics of 1/128 around 0.
    pieces = (
        positions.reshape(-1, 1).view(np.uint8)[:, :3],
        _byte(splats.opacities * 255.0),
        _byte(splats.f_dc * (0.15 * 255.0) + 127.5),
        _byte((splats.log_scales + 10.0) * 16.0),
        _pack_rotations_spz(splats.unit_quats),
        _byte(splats.f_rest * 128.0 + 128.0),
    )
    header = struct.pack("<IIIBBBB", magic, version, len(splats), splats.degree, fraction_bits, 0, 0)
    atomic_write_bytes(path, gzip.compress(b"".join((header, *(piece.tobytes() for piece in pieces))), mtime=0))


def _byte(values: Float[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N"]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _pack_rotations_spz(wxyz: Float32[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Pack quaternions into 32 bits: the index of the largest of x, y, z, w in two, the other three in ten each."""
    # q and -q are one rotation: make the largest component positive, then its value follows from the unit length.
    quats = np.roll(wxyz, -1, axis=1).astype(np.float64)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32) << 30
    # The other components are stored from the low bits up in reverse order.
    shift = np.zeros(len(quats), np.uint32)
    for axis in range(3, -1, -1):
        kept = largest != axis
        # The other three are at most 1 / sqrt(2) in magnitude: nine bits of size and one of sign.
        size = np.minimum(np.rint(np.abs(quats[:, axis]) * (511.0 * 2.0**0.5)), 511.0).astype(np.uint32)
        number = size | ((quats[:, axis] < 0).astype(np.uint32) << 9)
        packed |= np.where(kept, number << shift, 0).astype(np.uint32)
        shift += np.where(kept, 10, 0).astype(np.uint32)
    return packed.astype("<u4").reshape(-1, 1).view(np.uint8)


# --- SOG ------------------------------------------------------------------------------------------------------------

_MAX_PALETTE = 65536


def write_splat_sog(path: str | Path, splats: Splats) -> None:
    """Write splats as a bundled SOG version 2, lossless pictures in a zip; the same splats give the same bytes.

    A failed write leaves no file.

    Kept: positions in 16 bits of their logarithm an axis, rotations in three bytes and two bits, scales, colours and
    harmonics as indices into fitted codebooks of 256 values, opacity in 8 bits. Harmonics come from a palette of at
    most 65,536 sets, one a splat below that number. Normals are left out, and splats are sorted along a Morton curve.
    The axes are ours.
    """
    splats = _sort_by_morton(splats)
    # Pictures hold a splat a pixel; their sides are multiples of 4.
    side = 4 * math.ceil(math.sqrt(len(splats)) / 4) or 4
    height = max(4, 4 * math.ceil(len(splats) / side / 4))

    def picture(values: UInt8[np.ndarray, "N C"]) -> bytes:
        whole = np.zeros((side * height, 4), np.uint8)
        whole[:, 3] = 255
        whole[: len(values), : values.shape[1]] = values
        return _webp(whole.reshape(height, side, 4))

    # Positions on a symmetric logarithmic scale, in 16 bits an axis.
    flat = np.sign(splats.means) * np.log1p(np.abs(splats.means.astype(np.float64)))
    low, high = (flat.min(axis=0), flat.max(axis=0)) if len(flat) else (np.zeros(3), np.zeros(3))
    positions = np.rint((flat - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.uint16)
    # One codebook for the three axes of the scales, and one for the three colours.
    scale_book, scales = _codebook(splats.log_scales)
    color_book, colors = _codebook(splats.f_dc)
    alpha = np.rint(splats.opacities * 255.0).astype(np.uint8)
    meta = {
        "version": 2,
        "count": len(splats),
        "antialias": False,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }
    pieces = {
        "means_l.webp": picture((positions & 255).astype(np.uint8)),
        "means_u.webp": picture((positions >> 8).astype(np.uint8)),
        "scales.webp": picture(scales),
        "quats.webp": picture(_pack_rotations_sog(splats.unit_quats)),
        "sh0.webp": picture(np.hstack([colors, alpha[:, None]])),
    }
    # Spherical harmonics: a palette, its entries as indices into a codebook, and the palette index of each splat.
    if splats.degree and len(splats):
        palette, labels = _palette(splats.f_rest.reshape(len(splats), -1))
        book, entries = _codebook(palette)
        entries = entries.reshape(len(palette), -1, 3)
        rows = math.ceil(len(palette) / 64)
        table = np.zeros((rows * 64, entries.shape[1], 4), np.uint8)
        table[..., 3] = 255
        table[: len(palette), :, :3] = entries
        meta["shN"] = {
            "count": len(palette),
            "bands": splats.degree,
            "codebook": book.tolist(),
            "files": ["shn_centroids.webp", "shn_labels.webp"],
        }
        pieces["shn_centroids.webp"] = _webp(table.reshape(rows, -1, 4))
        pieces["shn_labels.webp"] = picture(np.stack([labels & 255, labels >> 8], axis=1).astype(np.uint8))
    write_package(path, {"meta.json": json.dumps(meta).encode(), **pieces})


def _webp(rgba: UInt8[np.ndarray, "H W 4"]) -> bytes:
    """Return a lossless WebP, with the colours of transparent pixels."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(rgba).save(out, "WEBP", lossless=True, exact=True, quality=70, method=4)
    return out.getvalue()


def _sort_by_morton(splats: Splats) -> Splats:
    """Sort splats along a Morton curve, so that neighbouring pixels are neighbours in space and compress well."""
    means = splats.means.astype(np.float64)
    low = means.min(axis=0, initial=np.inf)
    # Ten bits an axis; interleaving their bits orders cells along the curve.
    extent = float((means - low).max(initial=0.0)) or 1.0
    grid = np.minimum((means - low) / extent * 1024.0, 1023.0).astype(np.int64)
    code = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = np.argsort(code, kind="stable")
    names = ("means", "normals", "f_dc", "f_rest", "opacity_logits", "log_scales", "quats")
    return Splats(**{name: getattr(splats, name)[order] for name in names})


def _codebook(values: Float[np.ndarray, "N C"]) -> tuple[Float[np.ndarray, " 256"], UInt8[np.ndarray, "N C"]]:
    """Fit a codebook of 256 ascending values by k-means, and return it with the nearest index of each value."""
    flat = np.sort(values.astype(np.float64), axis=None)
    if not len(flat):
        return np.zeros(256), np.zeros(values.shape, np.uint8)
    # Start between quantiles and even steps: dense values get many entries, and rare ones one nearby.
    book = 0.5 * (np.quantile(flat, np.linspace(0.0, 1.0, 256)) + np.linspace(flat[0], flat[-1], 256))
    # k-means of sorted numbers: each cluster is an interval between midpoints, and its mean is a difference of prefix
    # sums. An entry without values stays where it is.
    total = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(12):
        cut = np.searchsorted(flat, 0.5 * (book[1:] + book[:-1]))
        ends = np.concatenate([[0], cut, [len(flat)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, (total[ends[1:]] - total[ends[:-1]]) / np.maximum(counts, 1), book)
    book = np.sort(book).astype(np.float32).astype(np.float64)
    nearest = np.searchsorted(0.5 * (book[1:] + book[:-1]), values.astype(np.float64))
    return book, nearest.astype(np.uint8)


def _palette(sets: Float[np.ndarray, "N D"]) -> tuple[Float[np.ndarray, "P D"], Int[np.ndarray, " N"]]:
    """Return a palette of at most 65,536 sets of harmonics, and the palette index of each splat.

    For more splats the palette is an even sample of them, improved by one step of k-means.
    """
    if len(sets) <= _MAX_PALETTE:
        return sets, np.arange(len(sets))
    palette = sets[np.linspace(0, len(sets) - 1, _MAX_PALETTE).astype(np.int64)].astype(np.float64)
    # Lloyd's step: each palette entry becomes the mean of the sets nearest to it, and the sets are assigned again.
    labels = cKDTree(palette).query(sets)[1]
    counts = np.bincount(labels, minlength=len(palette))
    sums = np.stack([np.bincount(labels, column, len(palette)) for column in sets.T.astype(np.float64)], axis=1)
    palette = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], palette)
    return palette, cKDTree(palette).query(sets)[1]


def _pack_rotations_sog(wxyz: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Pack quaternions: the three smaller components in order, and in alpha 252 plus the index of the largest one."""
    quats = wxyz.astype(np.float64)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    # The three other components lie in [-1, 1] / sqrt(2), mapped to 0..255.
    kept = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    small = np.clip(np.rint((kept * 2.0**0.5 * 0.5 + 0.5) * 255.0), 0, 255)
    return np.hstack([small, 252 + largest[:, None]]).astype(np.uint8)
