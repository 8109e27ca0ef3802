"""OBJ files: groups, colours, order; trimesh as a second reader."""

from __future__ import annotations

import numpy as np
import trimesh

from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.export import write_obj
from tests.export.templates import random_template


def test_groups_hold_the_faces_of_their_parts(tmp_path):
    template = random_template()
    write_obj(tmp_path / "a.obj", template)
    groups, faces = [], {}
    for line in (tmp_path / "a.obj").read_text().splitlines():
        kind, *rest = line.split()
        if kind == "g":
            groups.append(rest[0])
            faces[rest[0]] = []
        elif kind == "f":
            faces[groups[-1]].append([int(value.split("//")[0]) - 1 for value in rest])
    assert groups == list(template.part_names)
    for name in groups:
        np.testing.assert_array_equal(np.reshape(faces[name], (-1, 3)), template.faces[template.part_faces(name)])


def test_positions_order_and_colours_come_back(tmp_path):
    template = random_template()
    write_obj(tmp_path / "a.obj", template)
    back = read_mesh(tmp_path / "a.obj")
    np.testing.assert_allclose(back.mesh.vertices, template.vertices, atol=1e-7)
    np.testing.assert_array_equal(back.mesh.faces, template.faces)
    np.testing.assert_array_equal(back.vertex_colors, template.vertex_colors)
    lines = [line.split() for line in (tmp_path / "a.obj").read_text().splitlines()]
    normals = np.array([line[1:] for line in lines if line[0] == "vn"], float)
    np.testing.assert_allclose(normals, template.mesh.vertex_normals, atol=1e-4)
    assert all(len(set(corner.split("//"))) == 1 for line in lines if line[0] == "f" for corner in line[1:])


def test_trimesh_splits_the_same_groups(tmp_path):
    template = random_template()
    write_obj(tmp_path / "a.obj", template)
    scene = trimesh.load(tmp_path / "a.obj", split_groups=True, process=False)
    counts = sorted(len(mesh.faces) for mesh in scene.geometry.values())
    assert counts == sorted(int(template.part_faces(name).sum()) for name in template.part_names[:3])
