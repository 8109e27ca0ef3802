"""A solid's file read back: what a printer gets is closed and manifold and holds the volume that was meant."""

from __future__ import annotations

import re
from pathlib import Path

import igl
import numpy as np

from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.files.package_file import zip_member
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.topology import half_edges

MODEL = "3D/3dmodel.model"
"""The member of a 3MF package that has the surface."""
# Of the volume: single precision and six digits lose far less, a piece that is gone or turned over is more.
_TOLERANCE = 1e-3


def check_written(path: Path, mesh: TriangleMesh, *, per_metre: float) -> float:
    """The volume that a solid's file encloses, cubic metres, if the file is as good as the solid in memory.

    An STL has no vertices: corners at one place count as one, as slicers take them.

    Args:
        path: of a file that `write_solid` wrote.
        mesh: what it was written from, metres.
        per_metre: units of the file a metre.

    Raises:
        InputError: the file is open, not manifold, wound against itself, or of another volume.
    """
    vertices, faces = _read(path)
    problems = _problems(faces, len(vertices))
    volume, meant = _volume(vertices / per_metre, faces), _volume(mesh.vertices, mesh.faces)
    if not abs(volume - meant) <= _TOLERANCE * abs(meant):
        problems.append(f"{volume * 1e6:.6g} cm3")
    if problems:
        raise InputError(
            f"solid {path.suffix}, read back",
            expected=f"a closed, manifold surface of {meant * 1e6:.6g} cm3",
            received=", ".join(problems),
            remedy="write it larger (--height-mm) or into another format: details went below what its numbers tell "
            "apart",
        )
    return volume


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if path.suffix.lower() == ".3mf":
        model = zip_member(read_bytes(path), MODEL)
        points = re.findall(r'<vertex x="([^"]+)" y="([^"]+)" z="([^"]+)"/>', model)
        corners = re.findall(r'<triangle v1="(\d+)" v2="(\d+)" v3="(\d+)"/>', model)
        return np.array(points, dtype=np.float64).reshape(-1, 3), np.array(corners, dtype=np.int64).reshape(-1, 3)
    raw = read_raw_mesh(path)
    if path.suffix.lower() != ".stl":
        return raw.vertices, raw.faces
    vertices, place = np.unique(raw.vertices, axis=0, return_inverse=True)
    return vertices, place.ravel()[raw.faces]


def _problems(faces: np.ndarray, count: int) -> list[str]:
    """What keeps faces from bounding a solid, in words."""
    # Faces with two equal corners have no area; readers merge corners at one place, which makes some.
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    # A closed, oriented 2-manifold has every directed edge once, and its reverse once.
    edges = half_edges(faces[~flat])
    forth, back = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    several = len(forth) - len(np.unique(forth))
    found = {
        "faces that are no triangle": int(flat.sum()),
        "open edges": int(np.setxor1d(forth, back).size // 2),
        "edges of more than two faces, or wound against each other": several,
    }
    # The test of vertices assumes manifold edges and therefore comes last.
    if not any(found.values()):
        touching = np.unique(faces[:, 0]).size and int((~igl.is_vertex_manifold(faces)).sum())
        found["vertices in which the surface touches itself"] = touching
    return [f"{number} {what}" for what, number in found.items() if number]


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = (vertices - vertices.mean(axis=0))[faces]
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)
