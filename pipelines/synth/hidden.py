"""Skin that clothes always cover: left out of the pictures, so that no thin cloth lets it show through."""

from __future__ import annotations

import igl
import numpy as np

from pipelines.synth.person import PART_NAMES, Person
from smplxpp.core.mesh import TriangleMesh

# How far from a garment's border its cover is taken for lasting (a skirt's hem swings), and how far skin may lie below.
_FROM_BORDER = {"upper": 0.035, "lower": 0.13}
_BELOW = 0.09


def hidden_faces(person: Person, vertices: np.ndarray) -> np.ndarray:
    """(M,) bool: faces of skin well inside a garment in the frame with `vertices` (V, 3)."""
    count = person.body.vertex_count
    covered = np.zeros(count, dtype=bool)
    layers = TriangleMesh(vertices, person.tpose.faces)
    for name, margin in _FROM_BORDER.items():
        cloth = layers.submesh(person.face_part == PART_NAMES.index(name))[0]
        squared, face, closest = igl.point_mesh_squared_distance(vertices[:count], cloth.vertices, cloth.faces)
        inside = np.einsum("vi,vi->v", vertices[:count] - closest, cloth.face_normals[face]) < 0
        border = cloth.vertices[np.unique(cloth.border_edges)]
        away = np.sqrt(igl.point_mesh_squared_distance(closest, border, np.arange(len(border))[:, None])[0]) > margin
        covered |= inside & away & (squared < _BELOW**2)
    outer = person.body.part_labels == person.body.part_label_names.index("body")
    hidden = np.zeros(person.tpose.face_count, dtype=bool)
    body = np.flatnonzero(person.face_part == PART_NAMES.index("body"))
    hidden[body] = (covered & outer)[person.tpose.faces[body]].all(axis=1)
    return hidden
