"""PLY files as other tools write them: both byte orders, all types of lists, seams, foreign elements, false counts."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from smplxpp.core.errors import InputError
from smplxpp.core.mesh_files.mesh_io import read_mesh, read_raw_mesh

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
XYZ = "property float x\nproperty float y\nproperty float z\n"
KINDS = {  # as PLY names them, and numpy
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
}


def _binary(folder: Path, order: str, kinds: tuple[str, str], faces: list[list[int]]) -> Path:
    length, index = kinds
    mark = {"little": "<", "big": ">"}[order]
    head = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment made here\nelement vertex 4\n{XYZ}element face {len(faces)}\n"
    )
    head += (
        f"property uchar material\nproperty list {length} {index} vertex_indices\nproperty short label\nend_header\n"
    )
    body = VERTICES.astype(f"{mark}f4").tobytes()
    for k, face in enumerate(faces):
        body += b"\x05" + np.array(len(face), mark + KINDS[length]).tobytes()
        body += np.array(face, mark + KINDS[index]).tobytes() + np.array(k - 1, f"{mark}i2").tobytes()
    path = folder / "a.ply"
    path.write_bytes(head.encode() + body)
    return path


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize(
    "kinds", [("uchar", "int"), ("char", "uint"), ("int", "ushort"), ("uint16", "int8"), ("uint", "uchar")]
)
@pytest.mark.parametrize("faces", [[[0, 1, 2], [0, 2, 3]], [[0, 1, 2], [0, 1, 2, 3], [1, 2, 3]]])
def test_binary_files(tmp_path: Path, order: str, kinds: tuple[str, str], faces: list[list[int]]):
    raw = read_raw_mesh(_binary(tmp_path, order, kinds, faces))
    np.testing.assert_array_equal(raw.vertices, VERTICES)
    fans = [[face[0], face[k], face[k + 1]] for face in faces for k in range(1, len(face) - 1)]
    source = [k for k, face in enumerate(faces) for _ in face[2:]]
    np.testing.assert_array_equal(raw.faces, fans)
    np.testing.assert_array_equal(raw.face_properties["label"], np.array(source) - 1)  # a triangle has its polygon's
    assert (raw.source_faces is None) == (len(faces) == 2)


def _ascii(folder: Path, text: str, *, newline: str = "\n") -> Path:
    path = folder / "a.ply"
    path.write_bytes(text.replace("\n", newline).encode())
    return path


PLACES = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_headers_with_remarks_and_foreign_elements(tmp_path: Path, newline: str):
    text = "ply\nformat ascii 1.0\ncomment element vertex 9\nobj_info end_header?\n"
    text += "element camera 2\nproperty list int float k\n"
    text += f"element vertex 4\n{XYZ}property uchar quality\nelement edge 0\nproperty int a\nelement face 2\n"
    text += (
        "property list uchar int vertex_index\nend_header\n3 1 2 3\n1 7\n"
        + PLACES.replace("\n", " 9\n")
        + "3 0 1 2\n3 0 2 3\n"
    )
    raw = read_raw_mesh(_ascii(tmp_path, text, newline=newline))
    np.testing.assert_array_equal(raw.vertices, VERTICES)
    np.testing.assert_array_equal(raw.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(raw.vertex_properties["quality"], [9] * 4)


def test_binary_data_after_a_header_of_windows_lines(tmp_path: Path):
    path = _binary(tmp_path, "little", ("uchar", "int"), [[0, 1, 2]])
    head, _, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    np.testing.assert_array_equal(read_raw_mesh(path).faces, [[0, 1, 2]])


SEAMS = (
    f"ply\nformat ascii 1.0\ncomment TextureFile p.png\nelement vertex 4\n{XYZ}element face 2\n"
    "property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    f"{PLACES}3 0 1 2 6 0 0 0.9 0 0.9 0.9\n3 0 2 3 6 0.9 0.9 0.1 0.1 0.1 0.9\n"
)


def test_seams_of_texture_split_no_vertex(tmp_path: Path):
    Image.fromarray(np.array([[[10, 0, 0], [20, 0, 0]], [[30, 0, 0], [40, 0, 0]]], np.uint8)).save(tmp_path / "p.png")
    raw = read_raw_mesh(_ascii(tmp_path, SEAMS))
    np.testing.assert_array_equal(raw.vertices, VERTICES)
    # the first vertex has corners of 30 and 20, the third of 20 and 30
    np.testing.assert_array_equal(raw.vertex_colors[:, 0], [25, 40, 25, 10])


def test_rows_with_more_numbers_than_properties(tmp_path: Path):
    text = (
        SEAMS.replace("0.9 0.9\n3", "0.9 0.9 9 1 1 1\n3").replace("0.1 0.9\n", "0.1 0.9 9 1 1 1\n").replace("p.png", "")
    )
    with pytest.warns(UserWarning, match="colours are lost"):
        np.testing.assert_array_equal(read_raw_mesh(_ascii(tmp_path, text)).faces, [[0, 1, 2], [0, 2, 3]])


def test_float_colours_and_colours_of_16_bits(tmp_path: Path):
    for kind, value, expected in (("float", "0.5", 128), ("ushort", "65535", 255), ("uchar", "7", 7)):
        names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        text = f"ply\nformat ascii 1.0\nelement vertex 4\n{XYZ}{names}element face 1\n"
        text += (
            "property list uchar int vertex_indices\nend_header\n"
            + PLACES.replace("\n", f" {value}" * 3 + "\n")
            + "3 0 1 2\n"
        )
        assert (read_mesh(_ascii(tmp_path, text)).vertex_colors == expected).all()


def _header(vertex: str = "4", face: str = "1", extra: str = "") -> str:
    return (
        f"ply\nformat ascii 1.0\nelement vertex {vertex}\n{XYZ}{extra}element face {face}\n"
        f"property list uchar int vertex_indices\nend_header\n{PLACES}"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (_header(vertex=str(10**12)) + "3 0 1 2\n", "1000000000000 rows"),
        (_header(face=str(10**12)) + "3 0 1 2\n", "1000000000000 rows"),
        (_header(vertex="9" * 30) + "3 0 1 2\n", "lines of a PLY header"),
        (_header() + "3 0 1\n", "ends before them"),
        (_header() + "3 0 1 4\n", r"indices in \[0, 4\)"),
        (_header() + "3 0 1 -1\n", r"\[-1, 1\]"),
        (_header() + "3 0 1 0.5\n", "int32 numbers"),
        (_header() + "-3 0 1 2\n", "lengths of vertex_indices"),
        (_header() + "300 0 1 2\n", "lengths of vertex_indices|ends before them"),
        (_header() + "3 0 1 two\n", "the word 'two'"),
        (_header(extra="property float x\n"), "each property once"),
        (_header(extra="element vertex 4\n"), "each element once"),
        (_header(extra="property half u\n"), "lines of a PLY header"),
        (_header().replace("format ascii", "format binary_middle_endian"), "lines of a PLY header"),
        (_header(face="0"), "triangle mesh"),
        (_header().replace("float z", "float w") + "3 0 1 2\n", "x, y and z"),
        (
            f"ply\nformat ascii 1.0\nelement vertex 4\n{XYZ}element tristrips 1\nproperty list int int vertex_indices\n"
            f"end_header\n{PLACES}4 0 1 2 3\n",
            "triangle strips.*Export triangles",
        ),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path: Path, text: str, words: str):
    with pytest.raises(InputError, match=words):
        read_raw_mesh(_ascii(tmp_path, text))


def test_a_binary_count_beyond_the_file_is_refused_before_anything_is_made(tmp_path: Path):
    path = _binary(tmp_path, "little", ("uint", "int"), [[0, 1, 2]])
    data = path.read_bytes()
    path.write_bytes(data.replace(b"element vertex 4", b"element vertex 999999999999"))
    with pytest.raises(InputError, match="999999999999 rows"):
        read_raw_mesh(path)
    path.write_bytes(data[:-18] + b"\xff\xff\xff\x7f" + data[-14:])
    with pytest.raises(InputError, match="lengths of vertex_indices"):
        read_raw_mesh(path)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl", ".off", ".npz", ".pkl"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path, suffix: str):
    os.mkfifo(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match="regular file"):
        read_mesh(tmp_path / f"a{suffix}")
    (tmp_path / f"b{suffix}").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="regular file"):
        read_mesh(tmp_path / f"b{suffix}")


def test_coordinates_too_large_to_compute_with_are_named(tmp_path: Path):
    text = (_header() + "3 0 1 2\n").replace("1 1 0\n", "1 1e30 0\n")
    with pytest.raises(InputError, match=r"within 1e\+12.*first at index 2: \(1, 1e\+30, 0\)"):
        read_raw_mesh(_ascii(tmp_path, text))


@pytest.mark.parametrize("normals", [False, True])
def test_points_without_faces_are_read_where_they_are_asked_for(tmp_path: Path, normals: bool):
    names = XYZ + "".join(f"property float {name}\n" for name in ("nx", "ny", "nz") if normals)
    rows = [line + (" 0 0 1" if normals else "") for line in PLACES.splitlines()]
    path = _ascii(tmp_path, f"ply\nformat ascii 1.0\nelement vertex 4\n{names}end_header\n" + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match="not the point cloud"):
        read_raw_mesh(path)
    raw = read_raw_mesh(path, clouds=True)
    assert raw.is_cloud and raw.faces.shape == (0, 3)
    np.testing.assert_array_equal(raw.vertices, VERTICES)
    assert (raw.vertex_normals is None) != normals
    assert not normals or (raw.vertex_normals == [0, 0, 1]).all()
