"""STL and OFF files: both kinds of STL, colours and polygons in OFF, files that end too early."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from smplxpp.core.errors import InputError
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh

CORNERS = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0.5]]])


def _binary(title: bytes) -> bytes:
    rows = [np.concatenate([np.zeros((1, 3)), face]).astype("<f4").tobytes() + b"\1\0" for face in CORNERS]
    return title.ljust(80) + struct.pack("<I", 2) + b"".join(rows)


def _ascii(word: str = "vertex") -> bytes:
    facets = [
        "facet normal 0 0 1\n outer loop\n"
        + "".join(f"  {word} %g %g %g\n" % tuple(c) for c in face)
        + "endloop endfacet\n"
        for face in CORNERS
    ]
    return ("solid vertex one\n" + "".join(facets) + "endsolid\n").encode()


@pytest.mark.parametrize(
    "data", [_binary(b"made"), _binary(b"solid made"), _ascii(), _ascii("VERTEX"), _ascii().replace(b"\n", b"\r\n")]
)
def test_stl_keeps_three_corners_a_face(tmp_path: Path, data: bytes):
    (tmp_path / "a.stl").write_bytes(data)
    raw = read_raw_mesh(tmp_path / "a.stl")
    np.testing.assert_array_equal(raw.vertices, CORNERS.reshape(-1, 3))
    np.testing.assert_array_equal(raw.faces, [[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (_binary(b"made")[:-1], "183 bytes for 2 faces"),
        (_binary(b"made")[:80] + b"\xff\xff\xff\xff" + _binary(b"made")[84:], "4294967295 faces"),
        (_ascii().replace(b"vertex 1 0 0\n", b""), "three vertices"),
        (_ascii().replace(b"vertex 1 0 0\n", b"vertex 1 0\n"), "three vertices"),
        (_ascii().replace(b"vertex 1 0 0\n", b"vertex 1 0 zero\n"), "'zero'"),
        (b"", "0 bytes"),
    ],
)
def test_stl_says_what_is_wrong(tmp_path: Path, data: bytes, words: str):
    (tmp_path / "a.stl").write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_raw_mesh(tmp_path / "a.stl")


OFF = "OFF # a remark\n\n4 2 5\n0 0 0\n1 0 0 # here\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n3 0 1 2\n"


def test_off_keeps_order_and_colours(tmp_path: Path):
    path = tmp_path / "a.off"
    path.write_text(OFF)
    raw = read_raw_mesh(path)
    np.testing.assert_array_equal(raw.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    np.testing.assert_array_equal(raw.source_faces, [0, 0, 1])
    path.write_text(" COFF4 1 0\n" + "".join(f"{k} {k * k} 0 {k} 0 9 255\n" for k in range(4)) + "3 0 1 2\n")
    np.testing.assert_array_equal(read_raw_mesh(path).vertex_colors, [[k, 0, 9] for k in range(4)])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("4 2 5", "4000000000000 2 5", "a line for each"),
        ("4 2 5", "-4 2 5", "a line for each"),
        ("4 2 5", "nan 2 5", "a line for each"),
        ("1 1 0\n", "1 1\n", "three numbers"),
        ("4 0 1 2 3 255 0 0", "9 0 1 2 3 255 0 0", "as many corners"),
        ("3 0 1 2", "3 0 1 4", r"indices in \[0, 4\)"),
        ("3 0 1 2", "-3 0 1 2", "whole numbers"),
        ("OFF", "4OFF", "three coordinates"),
        ("OFF", "OFF BINARY", "ASCII"),
    ],
)
def test_off_says_what_is_wrong(tmp_path: Path, old: str, new: str, words: str):
    (tmp_path / "a.off").write_text(OFF.replace(old, new))
    with pytest.raises(InputError, match=words):
        read_raw_mesh(tmp_path / "a.off")
