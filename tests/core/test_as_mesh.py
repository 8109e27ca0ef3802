"""Meshes of other libraries are taken where a mesh is asked for, and given back."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from smplxpp.core import InputError, TriangleMesh, as_mesh
from smplxpp.metrics import compare, mesh_quality


def test_every_kind_of_mesh_is_the_same_mesh():
    box = trimesh.creation.box()
    mine = TriangleMesh(box.vertices, box.faces)
    for given in (mine, box, (box.vertices, box.faces), (box.vertices.tolist(), box.faces.tolist())):
        found = as_mesh(given)
        assert np.array_equal(found.vertices, mine.vertices) and np.array_equal(found.faces, mine.faces)
        assert type(found.vertices) is np.ndarray
    assert as_mesh(mine) is mine


def test_public_functions_take_other_meshes():
    box = trimesh.creation.icosphere(subdivisions=2)
    mine = as_mesh(box)
    moved = mine.with_vertices(mine.vertices + 0.001)
    assert compare(moved, box, samples=2000) == compare(moved, mine, samples=2000)
    assert mesh_quality((box.vertices, box.faces)) == mesh_quality(mine)


def test_other_things_are_refused_by_name():
    with pytest.raises(InputError, match=r"gt.*|true mesh"):
        compare(trimesh.creation.box(), "scan.ply")


def test_a_mesh_goes_back_to_trimesh(monkeypatch):
    mesh = TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]], [[0, 1, 2]])
    theirs = mesh.to_trimesh()
    assert theirs.vertices.shape == (4, 3) and theirs.faces.tolist() == [[0, 1, 2]]
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match="pip install trimesh"):
        mesh.to_trimesh()
