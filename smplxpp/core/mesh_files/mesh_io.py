"""Read mesh files (PLY, OBJ, glTF, STL, OFF, FBX, npz, pickle) and write PLY.

Nothing is merged, split, reordered or repaired on reading, so that labels in a second file stay valid. Vertices and
faces are those of the file, except that a polygon becomes a fan of triangles in its place.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files import as_numbers, atomic_write_bytes, read_arrays, regular_file
from smplxpp.core.foreign import MeshLike, as_mesh
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.fbx_file import read_fbx
from smplxpp.core.mesh_files.gltf_file import read_gltf
from smplxpp.core.mesh_files.obj_file import read_obj
from smplxpp.core.mesh_files.ply_file import read_ply
from smplxpp.core.mesh_files.raw_mesh import FileRig, RawMesh, color_bytes, require_coordinate_range
from smplxpp.core.mesh_files.stl_off_files import read_off, read_stl


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A checked mesh with the colours, properties, parts and rig of its file; see `RawMesh` for the shapes."""

    mesh: TriangleMesh
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None
    vertex_properties: dict[str, np.ndarray] = field(default_factory=dict)
    face_properties: dict[str, np.ndarray] = field(default_factory=dict)
    part_names: tuple[str, ...] = ()
    face_part: Int64[np.ndarray, " M"] | None = None
    rig: FileRig | None = None


def read_mesh(path: str | Path) -> MeshFile:
    """Read a mesh file and check its mesh.

    Raises:
        InputError: missing, unknown or unreadable file, no faces, or what `TriangleMesh` refuses.

    Example:
        >>> smplxpp.read_mesh("data/fixtures/person/scans/scan_000000.ply").mesh
        TriangleMesh(39,966 vertices, 80,000 faces)
    """
    raw = read_raw_mesh(path)
    try:
        mesh = TriangleMesh(raw.vertices, raw.faces)
    except InputError as error:
        raise InputError(
            f"{path}: {error.subject}", expected=error.expected, received=error.received, remedy=error.remedy
        ) from None
    found = MeshFile(mesh, raw.vertex_colors, raw.vertex_properties, raw.face_properties)
    return replace(found, part_names=raw.part_names, face_part=raw.face_part, rig=raw.rig)


def read_raw_mesh(path: str | Path, *, clouds: bool = False) -> RawMesh:
    """Read the arrays of a mesh file; they may hold NaN and infinity, which `smplxpp.clean.sanitize` repairs.

    Args:
        path: of the file.
        clouds: whether to accept points without faces (`RawMesh.is_cloud`).

    Raises:
        InputError: missing, unknown, damaged or compressed file, no faces, or coordinates over 1e12.
    """
    path = regular_file(path, subject="mesh file")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"mesh file {path}", expected=f"one of {', '.join(SUFFIXES)}", received=path.suffix or "none")
    raw = reader(path)
    if not len(raw.vertices) or (raw.is_cloud and not clouds):
        raise InputError(
            f"mesh file {path}",
            expected="a triangle mesh",
            received=f"{len(raw.vertices)} vertices, {len(raw.faces)} faces",
            remedy="export the surface, not the point cloud: of a run `smplxpp export RUN --model template --out FILE`",
        )
    require_coordinate_range(raw.vertices, subject=f"mesh file {path}")
    return raw


def _read_npz(path: Path) -> RawMesh:
    return _from_arrays(path, read_arrays(path, subject="mesh file"))


def _read_pickle(path: Path) -> RawMesh:
    from smplxpp.core.files.safe_pickle import safe_load

    loaded = safe_load(path)
    return _from_arrays(path, loaded if isinstance(loaded, dict) else {})


def _from_arrays(path: Path, values: Mapping[Any, Any]) -> RawMesh:
    """Make a mesh from arrays by name: vertices, faces or none for a point cloud, colours and normals if present."""
    subject = f"mesh file {path}"
    # Names that exporters and data sets use for the same arrays, the most specific first.
    names = {"vertices": ("vertices", "verts", "v", "points"), "faces": ("faces", "f"), "normals": ("normals",)}
    found = {key: next((values[k] for k in known if k in values), None) for key, known in names.items()}
    if found["faces"] is None and "points" in values:
        found["faces"] = np.empty((0, 3), np.int64)
    if found["vertices"] is None or found["faces"] is None:
        keys = sorted(map(str, values))
        raise InputError(subject, expected="arrays `vertices` and `faces`, or `points`", received=f"keys {keys}"[:300])
    vertices = as_numbers(found["vertices"], (None, 3), subject=f"{subject}: vertices", finite=False)
    faces = as_numbers(found["faces"], (None, 3), subject=f"{subject}: faces")
    # Indices may arrive as floats from MATLAB or pickles.
    if not ((faces == np.rint(faces)) & (np.abs(faces) < 2**53)).all():
        raise InputError(f"{subject}: faces", expected="whole numbers", received="others")
    colors = values.get("vertex_colors", values.get("colors"))
    if colors is not None:
        array = np.asarray(colors) if getattr(colors, "dtype", None) == np.uint8 else None
        if array is None:
            array = as_numbers(colors, subject=f"{subject}: vertex colours", finite=False)
        if array.ndim != 2 or array.shape[1] < 3 or len(array) != len(vertices):
            raise InputError(
                f"{subject}: vertex colours", expected=f"shape ({len(vertices)}, 3 or 4)", received=f"{array.shape}"
            )
        colors = color_bytes(array, subject=subject)
    normals = None
    if not len(faces) and found["normals"] is not None:
        normals = as_numbers(found["normals"], (len(vertices), 3), subject=f"{subject}: normals", finite=False)
    return RawMesh(vertices, faces.astype(np.int64), colors, vertex_normals=normals)


_READERS = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".vrm": read_gltf,
    ".stl": read_stl,
    ".off": read_off,
    ".fbx": read_fbx,
    ".npz": _read_npz,
    ".pkl": _read_pickle,
}
SUFFIXES = tuple(_READERS)


def write_ply(
    path: str | Path,
    mesh: MeshLike,
    *,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
    vertex_properties: dict[str, np.ndarray] | None = None,
    face_properties: dict[str, np.ndarray] | None = None,
) -> None:
    """Write a binary little-endian PLY atomically; coordinates and other floats become float32, integers int32."""
    mesh = as_mesh(mesh, subject="mesh")
    # Columns of a vertex and of a face: name, numpy type, values.
    vertex = [(axis, "<f4", mesh.vertices[:, k]) for k, axis in enumerate("xyz")]
    if vertex_colors is not None:
        vertex += [(name, "u1", np.asarray(vertex_colors)[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    vertex += _columns(vertex_properties)
    face = _columns(face_properties)
    ply_type = {"<f4": "float", "u1": "uchar", "<i4": "int"}
    header = [f"ply\nformat binary_little_endian 1.0\nelement vertex {mesh.vertex_count}"]
    header += [f"property {ply_type[kind]} {name}" for name, kind, _ in vertex]
    header += [f"element face {mesh.face_count}", "property list uchar int vertex_indices"]
    header += [f"property {ply_type[kind]} {name}" for name, kind, _ in face]
    # Header, then rows of vertices, then rows of faces, each in one structured array.
    buffer = io.BytesIO()
    buffer.write(("\n".join(header) + "\nend_header\n").encode())
    rows = np.zeros(mesh.vertex_count, dtype=[(name, kind) for name, kind, _ in vertex])
    for name, _, column in vertex:
        rows[name] = column
    buffer.write(rows.tobytes())
    faces = np.zeros(mesh.face_count, dtype=[("count", "u1"), ("index", "<i4", 3)] + [(n, k) for n, k, _ in face])
    faces["count"], faces["index"] = 3, mesh.faces
    for name, _, column in face:
        faces[name] = column
    buffer.write(faces.tobytes())
    atomic_write_bytes(path, buffer.getvalue())


def _columns(properties: dict[str, np.ndarray] | None) -> list[tuple[str, str, np.ndarray]]:
    columns = []
    for name, values in (properties or {}).items():
        values = np.asarray(values)
        columns.append((name, "<f4" if values.dtype.kind == "f" else "<i4", values))
    return columns
