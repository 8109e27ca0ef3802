"""A labelled ball, and label maps of it from all around."""

from __future__ import annotations

import numpy as np
import trimesh

from smplxpp.core import Camera, TriangleMesh
from smplxpp.raster import rasterize_mesh, view_directions


def sphere() -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return TriangleMesh(mesh.vertices, mesh.faces)


def halves(mesh: TriangleMesh) -> np.ndarray:
    return np.where(mesh.triangles.mean(axis=1)[:, 1] > 0, 3, 4)


def views_of(mesh: TriangleMesh, labels: np.ndarray, count: int = 8) -> list:
    out = []
    for direction in view_directions(count):
        camera = Camera.look_at(eye=4 * direction, target=np.zeros(3), fov_y_deg=35, width=96, height=96, up=(0, 0, 1))
        face = rasterize_mesh(mesh, camera).face_id
        out.append((camera, np.where(face >= 0, labels[face], -1)))
    return out
