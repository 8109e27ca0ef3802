"""FBX files made here as text, and the binary form of their settings: units, axes, nodes and colours of a scan."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from smplxpp.core import InputError, MissingExtraError
from smplxpp.core.mesh_files.fbx_file import _axes, _number
from smplxpp.core.mesh_files.mesh_io import read_mesh

CORNERS = np.array([[0.0, 0, 0], [50, 0, 0], [50, 0, 170], [0, 0, 170]])  # centimetres, z up, facing -y


def settings(up: int, front: tuple[int, int], scale: float) -> str:
    rows = {"UpAxis": up, "UpAxisSign": 1, "FrontAxis": front[0], "FrontAxisSign": front[1], "CoordAxis": 0}
    text = "".join(f'P: "{name}", "int", "Integer", "",{value}\n' for name, value in rows.items())
    return f'GlobalSettings: {{\nProperties70: {{\n{text}P: "UnitScaleFactor", "double", "Number", "",{scale}\n}}\n}}\n'


def write_fbx(path: Path, head: str, points: np.ndarray, *, shift: tuple[float, float, float] = (0, 0, 0)) -> None:
    """One square of two triangles below a node that is moved."""
    flat = ",".join(f"{v:g}" for v in points.ravel())
    path.write_text(
        f"""; FBX 7.4.0 project file
FBXHeaderExtension: {{
FBXHeaderVersion: 1003
FBXVersion: 7400
}}
{head}
Objects: {{
Geometry: 10, "Geometry::s", "Mesh" {{
Vertices: *{points.size} {{
a: {flat}
}}
PolygonVertexIndex: *4 {{
a: 0,1,2,-4
}}
GeometryVersion: 124
LayerElementMaterial: 0 {{
Version: 101
MappingInformationType: "AllSame"
ReferenceInformationType: "IndexToDirect"
Materials: *1 {{
a: 0
}}
}}
Layer: 0 {{
Version: 100
LayerElement: {{
Type: "LayerElementMaterial"
TypedIndex: 0
}}
}}
}}
Model: 20, "Model::s", "Mesh" {{
Version: 232
Properties70: {{
P: "Lcl Translation", "Lcl Translation", "", "A",{shift[0]},{shift[1]},{shift[2]}
}}
}}
Material: 30, "Material::m", "" {{
Version: 102
ShadingModel: "lambert"
Properties70: {{
P: "DiffuseColor", "Color", "", "A",1,0.5,0
}}
}}
}}
Connections: {{
C: "OO",10,20
C: "OO",20,0
C: "OO",30,20
}}
"""
    )


def test_units_axes_and_nodes_are_obeyed(tmp_path):
    pytest.importorskip("assimp_py")
    write_fbx(tmp_path / "z.fbx", settings(2, (1, -1), 1.0), CORNERS, shift=(0, 0, 10))
    found = read_mesh(tmp_path / "z.fbx")
    expected = np.array([[0, 0.1, 0], [0.5, 0.1, 0], [0.5, 1.8, 0], [0, 1.8, 0]])
    order = np.lexsort(found.mesh.vertices.round(6).T)
    np.testing.assert_allclose(found.mesh.vertices[order], expected[np.lexsort(expected.T)], atol=1e-6)
    assert found.mesh.face_count == 2 and found.mesh.face_areas.sum() == pytest.approx(0.85)
    np.testing.assert_array_equal(np.unique(found.vertex_colors, axis=0), [[255, 128, 0]])
    # Metres (100 centimetres) with y up: the same person.
    write_fbx(tmp_path / "m.fbx", settings(1, (2, 1), 100.0), CORNERS[:, [0, 2, 1]] / 100)
    assert np.ptp(read_mesh(tmp_path / "m.fbx").mesh.vertices[:, 1]) == pytest.approx(1.7)
    for text in ("FBXHeaderExtension: {", "solid"):
        (tmp_path / "bad.fbx").write_text(text)
        with pytest.raises(InputError, match="an FBX file"):
            read_mesh(tmp_path / "bad.fbx")


def test_settings_of_a_binary_file():
    def text(value: str) -> bytes:
        return struct.pack("<cI", b"S", len(value)) + value.encode()

    def entry(name: str, kind: str, value: bytes) -> bytes:
        return text(name) + text(kind) + text("Number") + text("") + value

    data = b"Kaydara" + entry("UnitScaleFactor", "double", b"D" + struct.pack("<d", 2.54))
    data += entry("UpAxis", "int", b"I" + struct.pack("<i", 2)) + entry("FrontAxis", "int", b"I" + struct.pack("<i", 1))
    data += entry("FrontAxisSign", "int", b"I" + struct.pack("<i", -1)) + bytes(16)
    assert _number(data, b"UnitScaleFactor", 1.0) == 2.54 and _number(data, b"CoordAxis", 0.0) == 0.0
    np.testing.assert_array_equal(_axes(data) @ [0, 0, 1], [0, 1, 0])
    np.testing.assert_array_equal(_axes(data) @ [0, -1, 0], [0, 0, 1])
    assert _number(data[:40], b"UnitScaleFactor", 7.0) == 7.0


def test_without_the_reader_the_remedies_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "assimp_py", None)
    write_fbx(tmp_path / "z.fbx", settings(2, (1, -1), 1.0), CORNERS)
    with pytest.raises(MissingExtraError, match=r"z\.fbx.*GLB.*extra fbx"):
        read_mesh(tmp_path / "z.fbx")


def test_loose_edges_are_refused_by_name(tmp_path):
    """It was "assumes triangulated faces", which tells nobody what to do."""
    pytest.importorskip("assimp_py")
    write_fbx(tmp_path / "z.fbx", settings(2, (1, -1), 1.0), CORNERS)
    text = (tmp_path / "z.fbx").read_text().replace("*4 {\na: 0,1,2,-4", "*6 {\na: 0,1,2,-4,0,-3")
    (tmp_path / "z.fbx").write_text(text)
    with pytest.raises(InputError, match=r"loose points or lines.*Loose Geometry"):
        read_mesh(tmp_path / "z.fbx")
