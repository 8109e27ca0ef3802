"""Label sets and label files."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from PIL import Image

from smplxpp.core import BACKGROUND, LABELS, InputError, display_colors
from smplxpp.segment import LABEL_SETS, labels_from_colors, map_labels, read_label_map, read_labels

SIZES = {"lip": 20, "cihp": 20, "atr": 18, "sapiens": 28, "capture": 7, "4ddress": 8}


@pytest.mark.parametrize("name", SIZES)
def test_sets_are_complete(name: str):
    ids = sorted(LABEL_SETS[name].ours)
    first = BACKGROUND if name == "4ddress" else 0
    ignored = [255] if name in ("lip", "cihp", "atr", "sapiens") else []
    assert ids == [*range(first, first + SIZES[name]), *ignored]
    assert set(LABEL_SETS[name].ours.values()) <= {BACKGROUND} | {label.id for label in LABELS}


@pytest.mark.parametrize(
    ("name", "theirs", "ours"),
    [
        ("lip", [0, 2, 5, 9, 12, 13, 18, 255], [-1, 1, 3, 4, 4, 0, 2, -1]),
        ("cihp", [10, 11, 19], [0, 5, 2]),
        ("atr", [3, 4, 6, 10, 11, 16], [6, 3, 4, 2, 0, 6]),
        ("sapiens", [2, 3, 8, 12, 16, 17, 21, 22], [0, 1, 2, 4, 0, 2, 0, 3]),
        ("capture", [0, 1, 2, 3, 4, 5, 6], [-1, 0, 1, 2, 3, 4, 0]),
        ("4ddress", [-1, 0, 5], [-1, 0, 5]),
    ],
)
def test_known_classes(name: str, theirs: list, ours: list):
    np.testing.assert_array_equal(map_labels(np.array(theirs), name), ours)


def test_unknown_ids_and_sets_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"received \[7\]"):
        map_labels(np.array([1, 7]), "capture")
    with pytest.raises(InputError, match="integers"):
        map_labels(np.array([0.5]), "capture")
    with pytest.raises(InputError, match="one of 4ddress"):
        map_labels(np.array([1]), "nobody")
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"7": "upper", "8": "cape"}))
    with pytest.raises(InputError, match="cape"):
        map_labels(np.array([7]), path)
    path.write_text(json.dumps({"7": "upper", "9": "background"}))
    np.testing.assert_array_equal(map_labels(np.array([[7, 9]], np.uint8), path), [[3, -1]])


@pytest.mark.parametrize("suffix", ["npz", "npy", "pkl"])
@pytest.mark.parametrize("count", [10, 16])
def test_label_arrays(tmp_path, suffix: str, count: int):
    ids = (np.arange(count) % 6).astype(np.uint8)
    path = tmp_path / f"labels.{suffix}"
    if suffix == "npz":
        np.savez(path, labels=ids, part=ids)
    elif suffix == "npy":
        np.save(path, ids)
    else:
        path.write_bytes(pickle.dumps({"scan_labels": ids}))
    np.testing.assert_array_equal(read_labels(path, vertex_count=10, face_count=16), ids)
    with pytest.raises(InputError, match="one a vertex"):
        read_labels(path, vertex_count=11, face_count=17)
    with pytest.raises(InputError, match="tells vertices from faces"):
        read_labels(path, vertex_count=count, face_count=count)


def test_ambiguous_or_missing_keys_are_refused(tmp_path):
    path = tmp_path / "two.npz"
    np.savez(path, label=np.zeros(10, int), face_labels=np.zeros(16, int))
    with pytest.raises(InputError, match="one of the keys"):
        read_labels(path, vertex_count=10, face_count=16)
    with pytest.raises(InputError, match="existing file"):
        read_labels(tmp_path / "none.npz", vertex_count=10, face_count=16)


def test_display_colours_come_back():
    ids = np.array([label.id for label in LABELS])
    colors = display_colors(ids).astype(int)
    np.testing.assert_array_equal(labels_from_colors(np.clip(colors + 6, 0, 255)), ids)
    assert labels_from_colors(np.array([[255, 255, 255]]))[0] == BACKGROUND


def test_labels_of_a_mesh_file(tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=1)
    ids = np.arange(len(ball.vertices)) % 6
    ball.visual.vertex_colors = np.c_[display_colors(ids), np.full(len(ids), 255)]
    path = tmp_path / "scan.ply"
    ball.export(path)
    counts = {"vertex_count": len(ball.vertices), "face_count": len(ball.faces)}
    np.testing.assert_array_equal(read_labels(path, **counts), ids)
    plain = trimesh.creation.icosphere(subdivisions=1)
    rows = [" ".join(map(str, [*v, i % 7])) for i, v in enumerate(plain.vertices)]
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(rows)}",
        "property float x",
        "property float y",
        "property float z",
        "property uchar label",
        f"element face {len(plain.faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    path.write_text("\n".join([*header, *rows, *("3 " + " ".join(map(str, f)) for f in plain.faces)]) + "\n")
    expected = map_labels(np.arange(len(rows)) % 7, "capture")
    np.testing.assert_array_equal(read_labels(path, label_set="capture", **counts), expected)


def test_label_maps(tmp_path):
    ids = np.array([[0, 1, 2], [3, 4, 6]], np.uint8)
    Image.fromarray(ids).save(tmp_path / "grey.png")
    palette = Image.fromarray(ids)
    palette = palette.convert("P")
    palette.putdata(ids.ravel().tolist())
    palette.save(tmp_path / "palette.png")
    np.save(tmp_path / "map.npy", ids.astype(np.int64))
    for name in ("grey.png", "palette.png", "map.npy"):
        np.testing.assert_array_equal(read_label_map(tmp_path / name, label_set="capture"), map_labels(ids, "capture"))
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "color.png")
    with pytest.raises(InputError, match="class indices"):
        read_label_map(tmp_path / "color.png", label_set="capture")


def test_unknown_ids_of_a_file_are_reported_with_its_name(tmp_path):
    np.save(tmp_path / "mine.npy", np.array([0, 1, 77]))
    with pytest.raises(InputError, match=r"mine\.npy.*77"):
        read_labels(tmp_path / "mine.npy", vertex_count=3, face_count=1)


def test_labels_of_polygons_reach_their_triangles(tmp_path):
    source = np.array([0, 0, 1, 2, 2, 2])
    np.save(tmp_path / "a.npy", np.array([3, 4, 5]))
    counts = {"vertex_count": 10, "face_count": 6}
    read = read_labels(tmp_path / "a.npy", **counts, source_faces=source)
    np.testing.assert_array_equal(read, [3, 3, 4, 5, 5, 5])
    with pytest.raises(InputError, match=r"10 labels.*or 6"):
        read_labels(tmp_path / "a.npy", **counts)
    with pytest.raises(InputError, match="tells vertices from faces"):
        read_labels(tmp_path / "a.npy", vertex_count=3, face_count=6, source_faces=source)


@pytest.mark.parametrize(("count", "words"), [(9, "merged vertices"), (12, "split vertices"), (1, "merged vertices")])
def test_the_hint_says_what_the_other_tool_did(tmp_path, count: int, words: str):
    np.save(tmp_path / "a.npy", np.zeros(count, int))
    with pytest.raises(InputError, match=f"the tool that wrote them {words}"):
        read_labels(tmp_path / "a.npy", vertex_count=10, face_count=16)


def test_damaged_label_files_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", label=np.zeros(10, int))
    np.save(tmp_path / "a.npy", np.zeros(10, int))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"label": [[1], [1, 2]]}))
    for name in ("a.npz", "a.npy"):
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-9])
    np.save(tmp_path / "b.npy", np.full(10, np.inf))
    np.save(tmp_path / "c.npy", np.array(["skin"] * 10))
    for name in ("a.npz", "a.npy", "a.pkl", "b.npy", "c.npy"):
        with pytest.raises(InputError):
            read_labels(tmp_path / name, vertex_count=10, face_count=16)
