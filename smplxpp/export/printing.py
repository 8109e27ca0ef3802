"""A closed surface as a file for printers and modellers: STL, 3MF, PLY, GLB."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path

import igl
import numpy as np
import pygltflib

from smplxpp.core import InputError, MeshLike, TriangleMesh, as_mesh, require_choice, write_ply
from smplxpp.core.files.atomic import atomic_path, atomic_write_bytes
from smplxpp.core.files.package_file import zip_bytes, zip_member
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.topology import half_edges
from smplxpp.export.gltf_buffers import BufferBuilder

MODEL = "3D/3dmodel.model"
"""The member of a 3MF package that has the surface."""


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
    # Of the volume: single precision and six digits lose far less, a piece that is gone or turned over is more.
    tolerance = 1e-3
    if not abs(volume - meant) <= tolerance * abs(meant):
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


SUFFIXES = (".stl", ".3mf", ".ply", ".glb")
PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_3MF_UNITS = {"m": "meter", "cm": "centimeter", "mm": "millimeter"}


def write_solid(path: str | Path, mesh: MeshLike, *, units: str = "mm") -> float:
    """Write a closed surface, whole or not at all; the suffix tells the format.

    STL and 3MF stand on a printer's bed: z up, the lowest point at 0. PLY and GLB keep +Y up, and GLB its metres, as
    glTF demands. The file is read back before it takes its place.

    Args:
        path: `.stl` (binary), `.3mf`, `.ply` or `.glb`.
        mesh: metres, +Y up.
        units: "m", "cm" or "mm".

    Returns:
        The volume that the file encloses, cubic metres.

    Raises:
        InputError: another suffix or unit; what was read back is not closed and manifold or has another volume.
    """
    mesh = as_mesh(mesh, subject="mesh")
    path = Path(path)
    check_solid_path(path)
    require_choice("option units", units, tuple(PER_METRE))
    with atomic_path(path) as temporary:
        _write(temporary, mesh, units)
        in_metres = path.suffix.lower() == ".glb"
        return check_written(temporary, mesh, per_metre=1.0 if in_metres else PER_METRE[units])


def _write(path: Path, mesh: TriangleMesh, units: str) -> None:
    suffix = path.suffix.lower()
    if suffix == ".glb":
        atomic_write_bytes(path, _glb(mesh))
        return
    points = mesh.vertices * PER_METRE[units]
    if suffix == ".ply":
        write_ply(path, mesh.with_vertices(points))
        return
    points = points @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y to z, z to -y
    points[:, 2] -= points[:, 2].min()
    upright = mesh.with_vertices(points)
    atomic_write_bytes(path, _stl(upright) if suffix == ".stl" else _3mf(upright, _3MF_UNITS[units]))


def check_solid_path(path: Path) -> None:
    """Refuse a suffix that no writer knows.

    Raises:
        InputError: it names those that are known.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"output {path}", expected=", ".join(SUFFIXES), received=path.suffix or "no suffix")


def _stl(mesh: TriangleMesh) -> bytes:
    """Binary STL: http://paulbourke.net/dataformats/stl/."""
    rows = np.zeros(mesh.face_count, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    rows["normal"], rows["corners"] = mesh.face_normals, mesh.triangles
    return b"smplxpp".ljust(80) + np.uint32(mesh.face_count).tobytes() + rows.tobytes()


def _3mf(mesh: TriangleMesh, unit: str) -> bytes:
    """The 3MF core specification's smallest package: content types, relationships, one model of one object."""
    vertices = '<vertex x="%.6g" y="%.6g" z="%.6g"/>' * mesh.vertex_count
    triangles = '<triangle v1="%d" v2="%d" v3="%d"/>' * mesh.face_count
    model = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        f'<model unit="{unit}" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        f'<metadata name="Application">smplxpp {metadata.version("smplxpp")}</metadata>'
        '<resources><object id="1" type="model"><mesh><vertices>'
        + vertices % tuple(mesh.vertices.ravel().tolist())
        + "</vertices><triangles>"
        + triangles % tuple(mesh.faces.ravel().tolist())
        + '</triangles></mesh></object></resources><build><item objectid="1"/></build></model>'
    )
    types = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
    )
    relations = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
        '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
        'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
    )
    return zip_bytes({"[Content_Types].xml": types, "_rels/.rels": relations, MODEL: model})


def _glb(mesh: TriangleMesh) -> bytes:
    gltf = pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator=f"smplxpp {metadata.version('smplxpp')}"), scene=0
    )
    buffers = BufferBuilder(gltf)
    attributes = pygltflib.Attributes(
        POSITION=buffers.add(mesh.vertices.astype(np.float32), target=pygltflib.ARRAY_BUFFER, bounds=True)
    )
    indices = buffers.add(mesh.faces.astype(np.uint32).ravel(), target=pygltflib.ELEMENT_ARRAY_BUFFER)
    gltf.meshes = [pygltflib.Mesh(primitives=[pygltflib.Primitive(attributes=attributes, indices=indices)])]
    gltf.nodes = [pygltflib.Node(mesh=0, name="solid")]
    gltf.scenes = [pygltflib.Scene(nodes=[0])]
    return buffers.glb()
