"""No damage to a mesh file leads to anything but a mesh of sound arrays or an `InputError`."""

from __future__ import annotations

import json
import pickle
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from smplxpp.core import GeometryWarning, InputError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh, read_raw_mesh, write_ply
from tests.core.gltf_maker import make_glb, make_gltf
from tests.core.mutations import mutations

BUDGET = 300
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
FACES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])

PLY = """ply
format ascii 1.0
comment TextureFile picture.png
element vertex 5
property float x
property float y
property float z
element face 3
property list uchar int vertex_indices
property list uchar float texcoord
property int label
end_header
0 0 0
1 0 0
1 1 0
0 1 0
0.5 0.5 1
3 0 1 4 6 0 0 1 0 0.5 0.5 7
3 1 2 4 6 0 0 1 0 0.5 0.5 8
4 3 2 1 0 8 0 0 1 0 1 1 0 1 9
"""
OBJ = """mtllib materials.mtl
o one
v 0 0 0
v 1 0 0
v 1 1 0
vt 0 0
vt 1 0.5
usemtl red
f 1/1 2/2 3/1
g two
v 0 1 0 1
v 0.5 0.5 1
usemtl pictured
f -1//1 -2//2 3//3 2//4
f 1 2 5
"""
STL = (
    "solid a\n"
    + "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in VERTICES[face])
        + "endloop\nendfacet\n"
        for face in FACES
    )
    + "endsolid a\n"
)
OFF = (
    "COFF\n5 3 0\n"
    + "".join(f"{x} {y} {z} 255 0 0 255\n" for x, y, z in VERTICES)
    + "3 0 1 4\n4 0 1 2 3 1 0 0\n3 2 3 4\n"
)


def _files(folder: Path) -> dict[str, bytes]:
    """A valid file of each format."""
    write_ply(folder / "made.ply", TriangleMesh(VERTICES, FACES), face_properties={"label": np.arange(4)})
    binary_ply = (folder / "made.ply").read_bytes()
    mixed = binary_ply[: binary_ply.index(b"end_header")].decode().replace("face 4", "face 2")
    mixed = mixed.replace("little", "big").encode() + b"end_header\n" + VERTICES.astype(">f4").tobytes()
    mixed += b"\x03" + np.array([0, 1, 4, 7], ">i4").tobytes() + b"\x04" + np.array([0, 1, 2, 3, 8], ">i4").tobytes()
    np.savez(folder / "made.npz", vertices=VERTICES, faces=FACES, colors=np.full((5, 3), 0.5))
    stl = bytes(80) + struct.pack("<I", 4)
    for face in FACES:
        stl += np.concatenate([np.zeros((1, 3)), VERTICES[face]]).astype("<f4").tobytes() + b"\0\0"
    return {
        "a.ply": PLY.encode(),
        "b.ply": binary_ply,
        "c.ply": mixed,
        "a.obj": OBJ.encode(),
        "a.stl": STL.encode(),
        "b.stl": stl,
        "a.off": OFF.encode(),
        "a.npz": (folder / "made.npz").read_bytes(),
        "a.pkl": pickle.dumps({"vertices": VERTICES, "faces": FACES, "colors": np.full((5, 4), 9, np.uint8)}),
        "a.gltf": make_gltf(VERTICES, FACES),
        "a.glb": make_glb(VERTICES, FACES),
    }


NAMES = ["a.ply", "b.ply", "c.ply", "a.obj", "a.stl", "b.stl", "a.off", "a.npz", "a.pkl", "a.gltf", "a.glb"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(tmp_path / "picture.png")
    (tmp_path / "materials.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl pictured\nmap_Kd picture.png\n")
    return tmp_path


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files_are_read_soundly_or_refused(folder: Path, name: str):
    valid = _files(folder)[name]
    path = folder / f"tried{Path(name).suffix}"
    path.write_bytes(valid)
    assert read_mesh(path).mesh.face_count >= 3
    refused = 0
    for data in mutations(valid, BUDGET, seed=14):
        path.write_bytes(data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GeometryWarning)
                raw = read_raw_mesh(path)
        except InputError:
            refused += 1
            continue
        count = len(raw.vertices)
        assert raw.vertices.shape == (count, 3) and raw.vertices.dtype == np.float64
        assert raw.faces.ndim == 2 and raw.faces.shape[1] == 3 and raw.faces.dtype == np.int64
        assert count <= 100 * len(data) and len(raw.faces) <= 100 * len(data)
        assert raw.vertex_colors is None or (raw.vertex_colors.shape, raw.vertex_colors.dtype) == ((count, 3), np.uint8)
        assert all(len(values) == count for values in raw.vertex_properties.values())
        assert all(len(values) == len(raw.faces) for values in raw.face_properties.values())
    assert 0 < refused < BUDGET


@pytest.mark.parametrize("damage", ["mtl", "picture"])
def test_damaged_materials_lose_colours_at_most(folder: Path, damage: str):
    (folder / "a.obj").write_text(OBJ)
    path = folder / {"mtl": "materials.mtl", "picture": "picture.png"}[damage]
    for data in mutations(path.read_bytes(), BUDGET // 3, seed=15):
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GeometryWarning)
            mesh = read_mesh(folder / "a.obj").mesh
        assert (mesh.vertex_count, mesh.face_count) == (5, 4)


@pytest.mark.long
def test_json_values_of_other_types_in_gltf(folder: Path):
    document = json.loads(make_gltf(VERTICES, FACES))
    path = folder / "a.gltf"
    tried = 0
    for nasty in (None, [], {}, "x", -1, 1.5, 10**30, [[1]], True):
        for keys in _paths(document):
            changed = json.loads(json.dumps(document))
            holder = changed
            for key in keys[:-1]:
                holder = holder[key]
            holder[keys[-1]] = nasty
            path.write_text(json.dumps(changed))
            tried += 1
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", GeometryWarning)
                    read_raw_mesh(path)
            except InputError:
                pass
    assert tried > 300


def _paths(value, before=()):
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        yield (*before, key)
        yield from _paths(child, (*before, key))
