"""Read STL and OFF meshes.

An STL file has no shared vertices but three corners per face. They are kept: 3 M vertices for M faces.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int64

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.polygons import cut_polygons
from smplxpp.core.mesh_files.raw_mesh import (
    RawMesh,
    as_bytes,
    color_bytes,
    count_between,
    parse_numbers,
    require_indices,
    word_starts,
)

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> RawMesh:
    """Read a binary or ASCII STL file.

    Raises:
        InputError: a file that ends before the faces that it announces, or words that are not numbers.
    """
    header = 84  # bytes of a binary file before the faces, the last four of them their number
    subject = f"mesh file {path}"
    data = read_bytes(path, subject="mesh file")
    count = int.from_bytes(data[80:header], "little") if len(data) >= header else -1
    # Binary files may begin with `solid` too. Their size fits their number of faces, and ASCII files contain `facet`.
    if data[:512].lstrip()[:5].lower() == b"solid" and len(data) != header + count * _RECORD.itemsize:
        if b"facet" in data[:4096].lower() or not count > 0:
            return _triangle_soup(_ascii_corners(data, subject))
    if count < 0 or len(data) < header + count * _RECORD.itemsize:
        raise InputError(
            subject,
            expected="an STL file: `solid`, or 80 bytes, a number of faces and 50 bytes a face",
            received=f"{len(data)} bytes" + (f" for {count} faces" if count >= 0 else ""),
            remedy="the file is damaged or incomplete: copy or export it again",
        )
    return _triangle_soup(np.frombuffer(data, _RECORD, count, header)["corners"].reshape(-1, 3))


def _ascii_corners(data: bytes, subject: str) -> Float64[np.ndarray, "C 3"]:
    text = re.findall(rb"(?im)^[ \t]*vertex[ \t]+([^\r\n]*)", data.replace(b"\r", b"\n"))
    numbers = parse_numbers(b"\n".join(text), subject=f"{subject}: vertex lines")
    if len(numbers) != 3 * len(text) or len(text) % 3:
        raise InputError(
            subject, expected="three vertices of three numbers a facet", received=f"{len(text)} with {len(numbers)}"
        )
    return numbers.reshape(-1, 3)


def _triangle_soup(corners: Float[np.ndarray, "C 3"]) -> RawMesh:
    return RawMesh(corners.astype(np.float64), np.arange(len(corners), dtype=np.int64).reshape(-1, 3))


def read_off(path: Path) -> RawMesh:
    """Read the vertices, faces and vertex colours (COFF) of an ASCII OFF file.

    Raises:
        InputError: no OFF file, a file that ends too early, or indices of missing vertices.
    """
    subject = f"mesh file {path}"
    text = re.sub(rb"#[^\r\n]*", b"", read_bytes(path, subject="mesh file")).replace(b"\r", b"\n")
    head = re.match(rb"\s*(?:ST)?(C?)(N?)OFF(?=[\s\d])(?!\s*BINARY)", text)
    if head is None:
        raise InputError(
            subject,
            expected="an ASCII OFF file of three coordinates a vertex",
            received=repr(text[:16]),
            remedy="save it as PLY",
        )
    # All numbers at once, with their count in each line that has any.
    text = text[head.end() :]
    values = parse_numbers(text, subject=subject)
    per_line = count_between(word_starts(text), np.concatenate([[0], np.flatnonzero(as_bytes(text) == 10) + 1]))
    per_line = per_line[per_line > 0]
    first = np.cumsum(per_line) - per_line
    counts = values[: per_line[0] if len(per_line) else 0][:2]
    if len(counts) != 2 or not (counts >= 0).all() or counts.sum() > len(per_line) - 1:
        raise InputError(
            subject,
            expected="numbers of vertices and faces, and a line for each",
            received=f"{' and '.join(f'{n:g}' for n in counts) or 'none'} and {max(len(per_line) - 1, 0)} lines",
            remedy="the file is damaged or incomplete: copy or export it again",
        )
    end_vertices, end_faces = 1 + int(counts[0]), 1 + int(counts[0]) + int(counts[1])
    if (per_line[1:end_vertices] < 3).any():
        raise InputError(f"{subject}: vertices", expected="three numbers a line", received="fewer")
    # Vertices, with colours after the coordinates (COFF) or after the normals (CNOFF).
    at = first[1:end_vertices, None] + np.arange(3)
    colors = None
    if head.group(1) and (per_line[1:end_vertices] >= (9 if head.group(2) else 6)).all():
        colors = color_bytes(values[at + (6 if head.group(2) else 3)], subject=subject)
    # Polygons: the number of corners, then their vertices.
    sizes = _whole(values[first[end_vertices:end_faces]], subject)
    if (per_line[end_vertices:end_faces] <= sizes).any():
        raise InputError(f"{subject}: faces", expected="as many corners as a line announces", received="fewer")
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    corners = _whole(values[np.repeat(first[end_vertices:end_faces] + 1, sizes) + within], subject)
    require_indices(corners, int(counts[0]), subject=subject)
    cut = cut_polygons(corners, sizes, values[at], subject=subject)
    return RawMesh(values[at], cut.faces, colors, source_faces=cut.source_faces)


def _whole(numbers: Float64[np.ndarray, " n"], subject: str) -> Int64[np.ndarray, " n"]:
    bad = ~((numbers >= 0) & (numbers < 2**53) & (numbers == np.rint(numbers)))
    if bad.any():
        raise InputError(f"{subject}: faces", expected="whole numbers, none below 0", received=f"{numbers[bad][0]:g}")
    return numbers.astype(np.int64)
