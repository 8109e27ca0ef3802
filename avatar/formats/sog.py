"""Splats as SOG, PlayCanvas's format of version 2: pictures without loss in a zip, and what their bytes stand for."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree

from avatar.formats.splats import Splats
from smplxpp.core.files.package_file import write_package

_MOST_PALETTE, _ROW = 65536, 64
_MODES = 252  # of a rotation's alpha: 252 says that w is the largest, 255 that z is
_ROUNDS = 12  # of k-means in one dimension, which starts from equal shares


def write_splat_sog(path: str | Path, splats: Splats) -> None:
    """Write splats as a bundled SOG, whole or not at all; the same splats give the same bytes.

    Kept: positions in 16 bits of their logarithm an axis, rotations in three bytes and two bits, scales, colours and
    harmonics as the nearest of 256 numbers each that fit them best, opacity in 8 bits. Harmonics come from a palette
    of at most 65,536 sets, which is one a splat below that. Normals are left out, and splats change their order, to
    that of a curve through space. The axes are ours.
    """
    splats = _in_order(splats)
    side = 4 * math.ceil(math.sqrt(len(splats)) / 4) or 4
    height = max(4, 4 * math.ceil(len(splats) / side / 4))

    def picture(values: UInt8[np.ndarray, "N C"]) -> bytes:
        whole = np.zeros((side * height, 4), np.uint8)
        whole[:, 3] = 255
        whole[: len(values), : values.shape[1]] = values
        return _webp(whole.reshape(height, side, 4))

    flat = np.sign(splats.means) * np.log1p(np.abs(splats.means.astype(np.float64)))
    low, high = (flat.min(axis=0), flat.max(axis=0)) if len(flat) else (np.zeros(3), np.zeros(3))
    places = np.rint((flat - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.uint16)
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
        "means_l.webp": picture((places & 255).astype(np.uint8)),
        "means_u.webp": picture((places >> 8).astype(np.uint8)),
        "scales.webp": picture(scales),
        "quats.webp": picture(_smallest_three(splats.unit_quats)),
        "sh0.webp": picture(np.hstack([colors, alpha[:, None]])),
    }
    if splats.degree and len(splats):
        palette, labels = _palette(splats.f_rest.reshape(len(splats), -1))
        book, entries = _codebook(palette)
        entries = entries.reshape(len(palette), -1, 3)
        rows = math.ceil(len(palette) / _ROW)
        table = np.zeros((rows * _ROW, entries.shape[1], 4), np.uint8)
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
    """Return a picture without loss; colours of what is transparent are kept too."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(rgba).save(out, "WEBP", lossless=True, exact=True, quality=70, method=4)
    return out.getvalue()


def _in_order(splats: Splats) -> Splats:
    """Return splats along Morton's curve: neighbours in pictures are neighbours in space, and pack well."""
    means = splats.means.astype(np.float64)
    low = means.min(axis=0, initial=np.inf)
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
    """Return 256 rising numbers, the means of what is nearest to them, and the nearest to each value."""
    flat = np.sort(values.astype(np.float64), axis=None)
    if not len(flat):
        return np.zeros(256), np.zeros(values.shape, np.uint8)
    # Half by rank and half evenly: dense values get many numbers, rare ones are not far from one.
    book = 0.5 * (np.quantile(flat, np.linspace(0.0, 1.0, 256)) + np.linspace(flat[0], flat[-1], 256))
    total = np.concatenate([[0.0], np.cumsum(flat)])
    for _ in range(_ROUNDS):
        cut = np.searchsorted(flat, 0.5 * (book[1:] + book[:-1]))
        ends = np.concatenate([[0], cut, [len(flat)]])
        counts = np.diff(ends)
        book = np.where(counts > 0, (total[ends[1:]] - total[ends[:-1]]) / np.maximum(counts, 1), book)
    book = np.sort(book).astype(np.float32).astype(np.float64)
    nearest = np.searchsorted(0.5 * (book[1:] + book[:-1]), values.astype(np.float64))
    return book, nearest.astype(np.uint8)


def _palette(sets: Float[np.ndarray, "N D"]) -> tuple[Float[np.ndarray, "P D"], Int[np.ndarray, " N"]]:
    """Return at most 65,536 sets of harmonics, and which one each splat takes.

    Beyond so many splats the palette is every so many-th of them, moved once to the means of those that take it.
    """
    if len(sets) <= _MOST_PALETTE:
        return sets, np.arange(len(sets))
    palette = sets[np.linspace(0, len(sets) - 1, _MOST_PALETTE).astype(np.int64)].astype(np.float64)
    labels = cKDTree(palette).query(sets)[1]
    counts = np.bincount(labels, minlength=len(palette))
    sums = np.stack([np.bincount(labels, column, len(palette)) for column in sets.T.astype(np.float64)], axis=1)
    palette = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], palette)
    return palette, cKDTree(palette).query(sets)[1]


def _smallest_three(wxyz: Float[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Pack rotations: the three smaller numbers in their order, and in alpha which of w, x, y, z is left out."""
    quats = wxyz.astype(np.float64)
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    kept = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    small = np.clip(np.rint((kept * 2.0**0.5 * 0.5 + 0.5) * 255.0), 0, 255)
    return np.hstack([small, _MODES + largest[:, None]]).astype(np.uint8)
