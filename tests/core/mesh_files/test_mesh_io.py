from __future__ import annotations

import numpy as np
import pytest
import trimesh

from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh, read_raw_mesh, write_ply


@pytest.fixture
def mesh() -> TriangleMesh:
    box = trimesh.creation.box(extents=(0.5, 1.5, 0.25))
    return TriangleMesh(box.vertices.astype(np.float32), box.faces)


def test_ply_round_trip_keeps_order_colours_and_properties(tmp_path, mesh):
    colors = np.arange(3 * mesh.vertex_count, dtype=np.uint8).reshape(-1, 3)
    labels = np.arange(mesh.vertex_count)
    confidence = np.linspace(0, 1, mesh.face_count, dtype=np.float32)
    path = tmp_path / "part.ply"
    write_ply(
        path,
        mesh,
        vertex_colors=colors,
        vertex_properties={"label": labels},
        face_properties={"confidence": confidence},
    )
    back = read_mesh(path)
    np.testing.assert_array_equal(back.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(back.vertex_colors, colors)
    np.testing.assert_array_equal(back.vertex_properties["label"], labels)
    np.testing.assert_array_equal(back.face_properties["confidence"], confidence)
    assert [p.name for p in tmp_path.iterdir()] == ["part.ply"]


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".off", ".ply"])
def test_vertex_order_is_the_files(tmp_path, mesh, suffix):
    path = tmp_path / f"box{suffix}"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    back = read_mesh(path).mesh
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(back.faces, mesh.faces)


def test_npz_mesh_with_colours_in_unit_range(tmp_path, mesh):
    path = tmp_path / "scan.npz"
    np.savez(path, vertices=mesh.vertices, faces=mesh.faces, colors=np.full((mesh.vertex_count, 4), 0.5))
    back = read_mesh(path)
    np.testing.assert_array_equal(back.vertex_colors, np.full((mesh.vertex_count, 3), 128, np.uint8))


def test_nan_is_named_and_raw_arrays_stay_readable(tmp_path, mesh):
    vertices = mesh.vertices.copy()
    vertices[3, 1] = np.nan
    path = tmp_path / "scan.npz"
    np.savez(path, vertices=vertices, faces=mesh.faces)
    with pytest.raises(InputError, match=r"scan\.npz.*first at index 3"):
        read_mesh(path)
    assert np.isnan(read_raw_mesh(path).vertices[3, 1])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("scan.xyz", b"0 0 0", r"one of \.ply"),
        ("scan.ply", b"ply\nnonsense", "end_header"),
        ("scan.obj", b"v 0 0 0\nv 1 0 0\n", "mesh"),
    ],
)
def test_unusable_files_are_named(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_mesh(path)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="existing file"):
        read_mesh(tmp_path / "none.ply")
