"""Solids as files, read back by trimesh and by our own readers."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.export.printing import check_written, write_solid


@pytest.fixture
def bottle() -> TriangleMesh:
    made = trimesh.creation.capsule(height=0.4, radius=0.1)
    turned = made.vertices @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return TriangleMesh(turned + [0.3, 0.2, -0.5], made.faces)


@pytest.mark.parametrize(("units", "factor"), [("mm", 1e3), ("cm", 1e2), ("m", 1.0)])
def test_stl_stands_on_the_bed_in_its_units(tmp_path: Path, bottle: TriangleMesh, units: str, factor: float):
    write_solid(tmp_path / "a.stl", bottle, units=units)
    made = trimesh.load(tmp_path / "a.stl")
    assert made.is_watertight and made.is_winding_consistent
    assert made.volume == pytest.approx(trimesh.Trimesh(bottle.vertices, bottle.faces).volume * factor**3, rel=1e-4)
    np.testing.assert_allclose(made.extents, np.ptp(bottle.vertices, axis=0)[[0, 2, 1]] * factor, rtol=1e-5)
    assert made.bounds[0, 2] == pytest.approx(0.0, abs=1e-6 * factor)


def test_glb_and_ply_keep_up_and_glb_its_metres(tmp_path: Path, bottle: TriangleMesh):
    for name, factor in (("a.glb", 1.0), ("a.ply", 1e3)):
        write_solid(tmp_path / name, bottle)
        back = read_mesh(tmp_path / name).mesh
        np.testing.assert_array_equal(back.faces, bottle.faces)
        np.testing.assert_allclose(back.vertices, bottle.vertices * factor, rtol=1e-5, atol=1e-6 * factor)


def test_3mf_is_a_package_of_one_object_and_the_same_bytes_again(tmp_path: Path, bottle: TriangleMesh):
    write_solid(tmp_path / "a.3mf", bottle)
    first = (tmp_path / "a.3mf").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.3mf") as package:
        assert package.namelist() == ["[Content_Types].xml", "_rels/.rels", "3D/3dmodel.model"]
        model = package.read("3D/3dmodel.model").decode()
    assert '<model unit="millimeter"' in model
    vertices = np.array(re.findall(r'x="([^"]+)" y="([^"]+)" z="([^"]+)"', model), float)
    triangles = np.array(re.findall(r'v1="(\d+)" v2="(\d+)" v3="(\d+)"', model), int)
    np.testing.assert_array_equal(triangles, bottle.faces)
    made = trimesh.Trimesh(vertices, triangles, process=False)
    assert made.is_watertight and made.bounds[0, 2] == pytest.approx(0.0, abs=1e-3)
    assert made.volume == pytest.approx(trimesh.Trimesh(bottle.vertices, bottle.faces).volume * 1e9, rel=1e-3)
    write_solid(tmp_path / "a.3mf", bottle)
    assert (tmp_path / "a.3mf").read_bytes() == first


def test_other_formats_and_units_are_refused(tmp_path: Path, bottle: TriangleMesh):
    with pytest.raises(InputError, match=r"\.stl, \.3mf"):
        write_solid(tmp_path / "a.obj", bottle)
    with pytest.raises(InputError, match="units"):
        write_solid(tmp_path / "a.stl", bottle, units="inch")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".stl", ".3mf", ".ply", ".glb"])
def test_the_file_is_read_back_and_holds_the_volume(tmp_path: Path, bottle: TriangleMesh, suffix: str):
    volume = trimesh.Trimesh(bottle.vertices, bottle.faces).volume
    for units in ("mm", "m"):
        assert write_solid(tmp_path / f"a{suffix}", bottle, units=units) == pytest.approx(volume, rel=1e-5)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: TriangleMesh(m.vertices, m.faces[1:]), "3 open edges"),
        (lambda m: TriangleMesh(m.vertices, np.concatenate([m.faces[:1, ::-1], m.faces[1:]])), "wound against"),
        (
            lambda m: TriangleMesh(m.vertices, np.concatenate([m.faces, m.faces[:1], m.faces[:1, ::-1]])),
            "more than two",
        ),
        (lambda m: m.with_vertices(m.vertices * 1e-3 + [1e4, 0, 0]), "received"),
    ],
)
def test_what_no_printer_takes_is_refused_and_leaves_no_file(tmp_path: Path, bottle: TriangleMesh, spoil, words: str):
    with pytest.raises(InputError, match=words):
        write_solid(tmp_path / "a.stl", spoil(bottle))
    assert not list(tmp_path.iterdir())


def test_another_volume_or_a_surface_that_touches_itself_is_told(tmp_path: Path, bottle: TriangleMesh):
    write_solid(tmp_path / "a.stl", bottle)
    with pytest.raises(InputError, match="cm3"):
        check_written(tmp_path / "a.stl", bottle.with_vertices(1.01 * bottle.vertices), per_metre=1e3)
    tip = int(bottle.vertices[:, 1].argmax())
    mirrored = 2 * bottle.vertices[tip] - bottle.vertices
    two = TriangleMesh(
        np.concatenate([bottle.vertices, mirrored]),
        np.concatenate([bottle.faces, bottle.faces[:, ::-1] + bottle.vertex_count]),
    )
    with pytest.raises(InputError, match="1 vertices in which the surface touches itself"):
        write_solid(tmp_path / "b.stl", two)
