"""OBJ files as other tools write them: many materials, references of all kinds, missing pictures, long files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh_files.mesh_io import read_mesh, read_raw_mesh

PLACES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def _write(folder: Path, text: str) -> Path:
    path = folder / "a.obj"
    path.write_bytes(text.encode())
    return path


def test_materials_groups_and_seams_neither_split_nor_reorder(tmp_path: Path):
    text = PLACES + "v 9 9 9\nvt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\n"
    text += "o a\nusemtl one\nf 3/1/1 1/2/1 2/3/1\ng b\nusemtl two\nf 1/3/1 3/1/1 4/2/1\nusemtl one\nf 1/1 2/2 4/3\n"
    raw = read_raw_mesh(_write(tmp_path, text))
    np.testing.assert_array_equal(raw.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]])
    np.testing.assert_array_equal(raw.faces, [[2, 0, 1], [0, 2, 3], [0, 1, 3]])
    assert raw.source_faces is None and raw.vertex_colors is None


def test_polygons_become_fans_in_their_place(tmp_path: Path):
    raw = read_raw_mesh(_write(tmp_path, PLACES + "f 1 2 3\nf 1 2 3 4\nf 2 3 4\n"))
    np.testing.assert_array_equal(raw.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3], [1, 2, 3]])
    np.testing.assert_array_equal(raw.source_faces, [0, 1, 1, 2])


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3\nf 1 3 4",
        "f 1// 2// 3//\nf 1//1 3//2 4//2",
        "f 1/1/ 2/1/ 3/1/\nf 1/1 3 4//7",
        "f -4 -3 -2\nf -4 -2 -1",
        "f  1 2 \\\n 3\r\n\tf 1 3 4 # a remark, f 1 2 3",
        "# f 4 4 4\nfoo f 1 2 3\nl 1 2\nf 1 2 3\nf 1 3 4\np 1",
    ],
)
def test_references_of_all_kinds(tmp_path: Path, faces: str):
    np.testing.assert_array_equal(read_raw_mesh(_write(tmp_path, PLACES + faces)).faces, [[0, 1, 2], [0, 2, 3]])


def test_negative_references_count_from_their_line(tmp_path: Path):
    raw = read_raw_mesh(_write(tmp_path, PLACES + "f -4 -3 -2\nv 5 5 5\nf -1 -2 -3\n"))
    np.testing.assert_array_equal(raw.faces, [[0, 1, 2], [4, 3, 2]])


def test_lone_returns_and_values_beside_the_coordinates(tmp_path: Path):
    text = "v 0 0 0 1\rv 1e0 0 0 1\rv 1 1 0 1\rf 1 2 3\r"
    np.testing.assert_array_equal(read_raw_mesh(_write(tmp_path, text)).vertices[2], [1, 1, 0])


@pytest.mark.parametrize(("scale", "expected"), [(1.0, 255), (255.0, 255), (0.5, 128)])
def test_colours_follow_coordinates(tmp_path: Path, scale: float, expected: int):
    text = "".join(f"v {k} {k * k} 0 {scale} 0 0\n" for k in range(3)) + "f 1 2 3\n"
    np.testing.assert_array_equal(read_raw_mesh(_write(tmp_path, text)).vertex_colors[0], [expected, 0, 0])


def test_colours_that_are_no_numbers_or_not_everywhere_are_said(tmp_path: Path):
    with pytest.warns(GeometryWarning, match="NaN"):
        raw = read_raw_mesh(_write(tmp_path, "v 0 0 0 nan 0 0\nv 1 0 0 1 1 1\nv 1 1 0 1 1 1\nf 1 2 3\n"))
    assert raw.vertex_colors is None
    with pytest.warns(GeometryWarning, match="colours of 1 of 3 vertices"):
        raw = read_raw_mesh(_write(tmp_path, "v 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n"))
    assert raw.vertex_colors is None


TEXTURED = "mtllib a.mtl\n" + PLACES + "vt 0.1 0.1\nvt 0.9 0.9\nvt 1 0\nusemtl m\nf 1/1 2/2 3/3\nf 1/2 3/2 4/2\n"


def test_the_picture_gives_a_vertex_the_mean_over_its_corners(tmp_path: Path):
    colors = np.array([[[10, 0, 0], [20, 0, 0]], [[30, 0, 0], [40, 0, 0]]], np.uint8)
    Image.fromarray(colors).save(tmp_path / "my picture.png")
    (tmp_path / "a.mtl").write_text("newmtl\tm\t\nKd 0 0 1\nmap_Kd -clamp on -s 1 1 my picture.png\n")
    raw = read_raw_mesh(_write(tmp_path, TEXTURED))
    # v is 0 at the picture's lower edge; the corners of the first vertex have 30 and 20, of the third 40 and 20
    np.testing.assert_array_equal(raw.vertex_colors[:, 0], [25, 20, 30, 20])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("", [30, 40, 10]),
        ("-s 1 2", [30, 40, 30]),  # 0.75 * 2 is 0.5 of the next picture, its upper half
        ("-o 0.5 0", [40, 30, 20]),
        ("-s -1 -o 1 0 0", [40, 30, 20]),
        ("-clamp on -o 0.5 0", [40, 40, 20]),
    ],
)
def test_options_of_a_picture_move_scale_and_clamp_it(tmp_path: Path, options: str, expected: list[int]):
    Image.fromarray(np.array([[[10], [20]], [[30], [40]]], np.uint8).repeat(3, axis=2)).save(tmp_path / "p.png")
    (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {options} p.png\n")
    text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.2 0.2\nvt 0.8 0.2\nvt 0.2 0.7\nusemtl m\nf 1/1 2/2 3/3\n"
    raw = read_raw_mesh(_write(tmp_path, text))
    np.testing.assert_array_equal(raw.vertex_colors[:, 0], expected)


def test_a_vertex_between_two_materials_has_the_colour_of_the_first(tmp_path: Path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
    text = "mtllib a.mtl\n" + PLACES + "usemtl blue\nf 1 2 3\nusemtl red\nf 1 3 4\n"
    np.testing.assert_array_equal(
        read_raw_mesh(_write(tmp_path, text)).vertex_colors[:, ::2], [[0, 255], [0, 255], [0, 255], [255, 0]]
    )


def test_names_of_other_machines_are_looked_for_beside_the_file(tmp_path: Path):
    Image.fromarray(np.full((1, 1, 3), 7, np.uint8)).save(tmp_path / "p.png")
    for name in ("C:\\Users\\me\\p.png", "/home/me/p.png", "../../p.png", ".\\p.png"):
        (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {name}\n")
        assert (read_raw_mesh(_write(tmp_path, TEXTURED)).vertex_colors == 7).all()


def test_a_lost_picture_or_material_file_is_named_and_the_geometry_read(tmp_path: Path):
    with pytest.warns(GeometryWarning, match=r"'a\.mtl' is not in its folder"):
        assert read_mesh(_write(tmp_path, TEXTURED)).mesh.vertex_count == 4
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd gone.png\n")
    with pytest.warns(GeometryWarning, match=r"'gone\.png' is not in its folder"):
        file = read_mesh(_write(tmp_path, TEXTURED))
    assert file.mesh.face_count == 2 and file.vertex_colors is None


def test_pictures_outside_the_folder_and_huge_ones_are_not_opened(tmp_path: Path):
    inner = tmp_path / "inner"
    inner.mkdir()
    Image.fromarray(np.zeros((1, 1, 3), np.uint8)).save(tmp_path / "secret.png")
    (inner / "a.mtl").write_text("newmtl m\nmap_Kd ../secret.png\n")
    with pytest.warns(GeometryWarning, match="not in its folder"):
        assert read_raw_mesh(_write(inner, TEXTURED)).vertex_colors is None
    small = tmp_path / "small.bmp"
    Image.fromarray(np.zeros((1, 1, 3), np.uint8)).save(small)
    header = bytearray(small.read_bytes())
    header[18:26] = (60000).to_bytes(4, "little") * 2
    (inner / "huge.bmp").write_bytes(header)
    (inner / "a.mtl").write_text("newmtl m\nmap_Kd huge.bmp\n")
    with pytest.warns(GeometryWarning, match="3600000000 pixels|60000 x 60000 pixels"):
        assert read_raw_mesh(_write(inner, TEXTURED)).vertex_colors is None


def test_a_material_without_picture_gives_its_kd(tmp_path: Path):
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 0.5 0\n")
    assert (read_raw_mesh(_write(tmp_path, TEXTURED)).vertex_colors == [255, 128, 0]).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "three numbers"),
        ("v 0 0 zero\n", "the word 'zero'"),
        ("v 0 0 1-2\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "numbers"),
        (PLACES + "f 1 2 5\n", r"indices in \[0, 4\)"),
        (PLACES + "f 0 1 2\n", r"indices in \[-1"),
        (PLACES + "f -5 1 2\n", r"indices in \[-1"),
        (PLACES + "f 1 2 99999999999999999999\n", "whole numbers"),
        (PLACES + "f 1 2 1.5\n", "whole numbers"),
        (PLACES + "f 1 2 /3\n", "name a vertex"),
        (PLACES, "triangle mesh"),
        ("", "triangle mesh"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path: Path, text: str, words: str):
    with pytest.raises(InputError, match=words):
        read_raw_mesh(_write(tmp_path, text))


def test_faces_of_two_corners_are_left_out_and_counted(tmp_path: Path):
    with pytest.warns(GeometryWarning, match="1 faces with fewer than three corners"):
        raw = read_raw_mesh(_write(tmp_path, PLACES + "f 1 2\nf 1 2 3\n"))
    np.testing.assert_array_equal(raw.source_faces, [1])


def test_a_face_of_many_corners(tmp_path: Path):
    count = 100_000
    raw = read_raw_mesh(_write(tmp_path, PLACES + "f " + " ".join("1234"[k % 4] for k in range(count)) + "\n"))
    assert len(raw.faces) == count - 2


def test_files_longer_than_a_block_keep_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    faces = rng.integers(0, 50, (200, 3))
    vertices = rng.integers(0, 99, (50, 3))
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    for k, (a, b, c) in enumerate(faces + 1):
        lines += [f"usemtl m{k % 3}", f"f {a} {b}//1 {c}/3"]
    path = _write(tmp_path, "\n".join(lines))
    monkeypatch.setattr("smplxpp.core.mesh_files.obj_file._BLOCK", 100)
    raw = read_raw_mesh(path)
    np.testing.assert_array_equal(raw.vertices, vertices)
    np.testing.assert_array_equal(raw.faces, faces)


# --- polygons --------------------------------------------------------------------------------------------------------

STAR = np.array([[(0.4, 1.0)[k % 2] * f(k * np.pi / 7) for f in (np.cos, np.sin)] for k in range(14)])
SPIRAL = [
    (0, 0),
    (6, 0),
    (6, 6),
    (1, 6),
    (1, 2),
    (4, 2),
    (4, 4),
    (3, 4),
    (3, 3),
    (2, 3),
    (2, 5),
    (5, 5),
    (5, 1),
    (0, 1),
]
POLYGONS = {
    "dart": [(0, 0), (2, -2), (0, 3), (-2, -2)],
    "dart from its wing": [(2, -2), (0, 3), (-2, -2), (0, 0)],
    "L": [(0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)],
    "arrow": [(0, 1), (3, 1), (3, 0), (5, 2), (3, 4), (3, 3), (0, 3)],
    "star": STAR,
    "spiral": SPIRAL,
    "with corners on its edges": [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (1, 1), (1, 2), (1, 3), (0, 3), (0, 1.5)],
}


def _written(folder: Path, suffix: str, points: np.ndarray) -> Path:
    """The polygon as one face of a file, behind a triangle and before a square that stay as they are."""
    path, n = folder / f"a.{suffix}", len(points)
    faces = [[0, 1, 2], list(range(n)), [0, 1, 2, 3]]
    lines = [" ".join(f"{value:.9g}" for value in point) for point in points]
    if suffix == "obj":
        text = "".join(f"v {line}\n" for line in lines)
        text += "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)
    else:
        head = f"OFF\n{n} 3 0\n"
        if suffix == "ply":
            head = f"ply\nformat ascii 1.0\nelement vertex {n}\n"
            head += "".join(f"property float {axis}\n" for axis in "xyz")
            head += "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
        text = head + "".join(f"{line}\n" for line in lines)
        text += "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in faces)
    path.write_text(text)
    return path


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
@pytest.mark.parametrize("name", POLYGONS)
def test_concave_polygons_keep_their_area_and_winding(tmp_path: Path, suffix: str, name: str):
    """Fans about the first corner covered what lies outside of them, with triangles turned over."""
    flat = np.array(POLYGONS[name], dtype=np.float64)
    shifted = np.roll(flat, 1, axis=0)
    whole = 0.5 * float((shifted[:, 0] * flat[:, 1] - shifted[:, 1] * flat[:, 0]).sum())
    # In a slanted plane, far from the origin; the polygon's own orientation is the winding of each of its triangles.
    x, y = np.array([0.8, 0.0, 0.6]), np.array([0.36, 0.8, -0.48])
    points = flat[:, :1] * x + flat[:, 1:] * y + [50.0, -20.0, 10.0]
    raw = read_raw_mesh(_written(tmp_path, suffix, points))
    assert raw.source_faces is not None
    own = raw.faces[raw.source_faces == 1]
    a, b, c = (raw.vertices[own[:, k]] for k in range(3))
    areas = 0.5 * np.cross(b - a, c - a) @ np.cross(x, y) * np.sign(whole)
    assert len(own) == len(flat) - 2 and areas.min() > -1e-5
    assert areas.sum() == pytest.approx(abs(whole), rel=1e-6)
    # A triangulation uses every side of the polygon once, and every diagonal twice.
    sides = np.sort(np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]), axis=1)
    _, count = np.unique(sides, axis=0, return_counts=True)
    assert (count == 1).sum() == len(flat) and set(count) <= {1, 2}
    np.testing.assert_array_equal(raw.faces[raw.source_faces == 0], [[0, 1, 2]])


def test_polygons_that_cross_themselves_are_told(tmp_path: Path):
    crossing = [(0, 0), (3, 0), (3, 3), (0, 3), (4, 1), (1, -1), (1, 4)]
    points = np.array([(x, y, 0.0) for x, y in crossing], dtype=np.float64)
    with pytest.warns(GeometryWarning, match="1 polygons that cross themselves"):
        raw = read_raw_mesh(_written(tmp_path, "obj", points))
    assert len(raw.faces) == 1 + 5 + 2


# --- names -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "gb18030", "shift_jis", "cp1251"])
def test_names_of_other_alphabets(tmp_path: Path, encoding: str):
    """Names that are no UTF-8 became the same signs, so that two materials were one, and no texture was found."""
    word = "кожа" if encoding == "cp1251" else "皮膚"
    other = "куна" if encoding == "cp1251" else "青布"
    Image.new("RGB", (2, 2), (10, 200, 30)).save(tmp_path / f"{word}.PNG")
    library = f"newmtl {word}\nmap_Kd {word}.png\nnewmtl {other}\nKd 1 0 0\n"
    (tmp_path / f"{word}.mtl").write_bytes(library.encode(encoding))
    text = f"mtllib {word}.mtl\n{PLACES}v 5 5 5\nvt 0 0\nusemtl {word}\nf 1/1 2/1 3/1\nusemtl {other}\nf 4/1 5/1 5/1\n"
    (tmp_path / "a.obj").write_bytes(text.encode(encoding))
    colors = read_raw_mesh(tmp_path / "a.obj").vertex_colors
    np.testing.assert_array_equal(colors[[0, 4]], [[10, 200, 30], [255, 0, 0]])


def test_many_missing_libraries_are_one_warning(tmp_path: Path):
    text = "".join(f"mtllib x{k}.mtl\n" for k in range(3000)) + f"usemtl a\n{PLACES}f 1 2 3\n"
    with pytest.warns(GeometryWarning, match=r"'x0\.mtl' and 999 more are not in its folder") as caught:
        read_raw_mesh(_write(tmp_path, text))
    assert len(caught) == 1


def test_materials_that_look_alike_are_one(tmp_path: Path):
    """A hundred thousand names for one picture took half a minute, a search through all faces for each of them."""
    Image.fromarray(np.full((4, 4, 3), 90, np.uint8)).save(tmp_path / "t.png")
    (tmp_path / "m.mtl").write_text(
        "".join(f"newmtl m{k}\n{look}\n" for k, look in enumerate(["map_Kd t.png"] * 3 + ["Kd 1 0 0"]))
    )
    faces = "".join(f"usemtl m{k}\nf 1/1 {k + 2}/2 {k + 3}/3\n" for k in range(4))
    places = "v 0 0 0\n" + "".join(f"v {k} 1 {k * k}\n" for k in range(6)) + "vt 0 0\nvt 1 0\nvt 1 1\nmtllib m.mtl\n"
    raw = read_raw_mesh(_write(tmp_path, places + faces))
    assert raw.pictures is not None and len(raw.pictures.load) == 1
    np.testing.assert_array_equal(raw.pictures.picture, [0, 0, 0, -1])
    np.testing.assert_array_equal(raw.vertex_colors[[0, 1, 5]], [[90] * 3, [90] * 3, [255, 0, 0]])
