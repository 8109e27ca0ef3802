"""Files of arrays that stages leave for each other: whole, or refused with what to do."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from pipelines.runs.arrays import load_arrays, read_named, save_arrays
from pipelines.runs.artefacts import load_parts, load_scan, load_weights
from pipelines.runs.layout import PARTS_WITHOUT_WEBS, SCAN, WEIGHTS
from smplxpp.core.errors import InputError

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
    for file, load in ((SCAN, load_scan), (PARTS_WITHOUT_WEBS, load_parts), (WEIGHTS, load_weights)):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        save_arrays(tmp_path / file, {"scan": {"faces": np.zeros((0, 3), int)}})
        with pytest.raises(InputError, match="received a file without it"):
            load(tmp_path)
