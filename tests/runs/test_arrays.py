"""Files of arrays that stages leave for each other: whole, or refused with what to do."""

from __future__ import annotations

import io
import zipfile
from dataclasses import fields
from functools import partial

import numpy as np
import pytest

from pipelines.runs.artefacts import (
    load_arrays,
    load_canonical,
    load_parts,
    load_scan,
    load_scan_labels,
    load_source_faces,
    load_weights,
    read_named,
    save_arrays,
)
from pipelines.runs.layout import CANONICAL, PARTS_WITHOUT_BRIDGES, SCAN, SCAN_LABELS, WEIGHTS
from smplxpp.build.data import Part
from smplxpp.core import InputError, SkinWeights, TriangleMesh

GROUPS = {"shirt": {"vertices": np.eye(3), "label": np.array(2)}, "a/b": {}}


def test_groups_come_back(tmp_path):
    save_arrays(tmp_path / "a.npz", GROUPS)
    back = load_arrays(tmp_path / "a.npz")
    assert list(back) == ["shirt"] and np.array_equal(back["shirt"]["vertices"], np.eye(3))
    assert np.array_equal(read_named(tmp_path / "a.npz", "shirt/label")[0], 2)


def test_what_lacks_an_array_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", vertices=np.eye(3))
    with pytest.raises(InputError, match=r"array labels, received a file without it.*delete the stage"):
        read_named(tmp_path / "a.npz", "vertices", "labels")
    with pytest.raises(InputError, match="arrays in groups, received vertices"):
        load_arrays(tmp_path / "a.npz")


def test_damaged_files_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    save_arrays(path, GROUPS)
    data = path.read_bytes()
    objects = io.BytesIO()
    np.save(objects, np.array([object()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(tmp_path / "objects.npz", "w") as archive:
        archive.writestr("shirt/vertices.npy", objects.getvalue())
    huge = bytearray(data)
    at = data.index(b"(3, 3)")
    huge[at : at + 6] = b"(9, 9)"
    contents = [b"", b"PK", data[:-30], data[: len(data) // 2], bytes(huge), (tmp_path / "objects.npz").read_bytes()]
    for content in contents:
        path.write_bytes(content)
        with pytest.raises(InputError, match="delete the stage's folder"):
            load_arrays(path)


def test_artefacts_without_their_arrays(tmp_path):
    mesh = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    parts = {"scan": Part(mesh, 3, np.arange(3), np.zeros((3, 3), np.uint8))}
    weights = partial(load_weights, parts=parts)
    for file, load in ((SCAN, load_scan), (PARTS_WITHOUT_BRIDGES, load_parts), (WEIGHTS, weights)):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        save_arrays(tmp_path / file, {"scan": {"faces": np.zeros((0, 3), int)}})
        with pytest.raises(InputError, match="received a file without it"):
            load(tmp_path)


def test_artefacts_of_other_kinds_name_their_file(tmp_path):
    """Whatever one array of a stage's file is replaced by, the reader refuses it or nothing but numbers has changed."""
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    plain = {"vertices": mesh.vertices, "faces": mesh.faces, "colors": np.zeros((3, 3), np.uint8)}
    plain |= {"source_vertex": np.arange(3), "label": np.array(3)}
    weights = SkinWeights.from_dense(np.eye(3), policies=("matched",))
    told = {field.name: np.asarray(getattr(weights, field.name)) for field in fields(SkinWeights)}
    parts = {"a": Part(mesh, 3, plain["source_vertex"], plain["colors"])}
    readers = {
        SCAN: ("scan", plain, load_scan),
        PARTS_WITHOUT_BRIDGES: ("a", plain, load_parts),
        WEIGHTS: ("a", told, partial(load_weights, parts=parts)),
        CANONICAL: ("a", {"vertices": mesh.vertices}, partial(load_canonical, parts=parts)),
    }
    foreign = [
        np.array(0.5),
        np.zeros((0,)),
        np.array(["x"]),
        np.full((3, 3), np.nan),
        np.zeros((3, 3, 3)),
        np.arange(7),
    ]
    for file, (group, arrays, load) in readers.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        save_arrays(tmp_path / file, {group: arrays})
        load(tmp_path)
        refused = 0
        for name in arrays:
            for value in foreign:
                save_arrays(tmp_path / file, {group: {**arrays, name: value}})
                try:
                    load(tmp_path)
                except InputError as error:
                    assert str(tmp_path / file) in str(error)
                    refused += 1
        assert refused >= 4 * (len(arrays) - 1), file
    save_arrays(tmp_path / SCAN, {"scan": {"source_face": np.arange(2)}})
    assert load_source_faces(tmp_path).tolist() == [0, 1]
    (tmp_path / SCAN_LABELS).parent.mkdir(exist_ok=True)
    for labels in (np.zeros(4, np.int64), np.zeros(5)):
        np.savez(tmp_path / SCAN_LABELS, face_labels=labels)
        with pytest.raises(InputError, match="face_labels"):
            load_scan_labels(tmp_path, 5)
