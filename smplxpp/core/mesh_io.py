"""Mesh files: read anything trimesh reads (PLY, OBJ, GLB, STL, OFF) and our npz; write PLY.

Nothing is merged, reordered or repaired on reading, so labels that come in a second file keep their meaning.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh

SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off", ".npz", ".pkl")


@dataclass(frozen=True, eq=False)
class RawMesh:
    """The arrays of a mesh file before any check.

    Attributes:
        vertices: (N, 3) float64, may hold NaN. faces: (M, 3) int64.
        vertex_colors: (N, 3) uint8 or None.
        vertex_properties, face_properties: other per-element arrays by name (PLY).
    """

    vertices: Float64[np.ndarray, "N 3"]
    faces: Int64[np.ndarray, "M 3"]
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None
    vertex_properties: dict[str, np.ndarray] = field(default_factory=dict)
    face_properties: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A checked mesh and what came with it; see `RawMesh` for the shapes."""

    mesh: TriangleMesh
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None
    vertex_properties: dict[str, np.ndarray] = field(default_factory=dict)
    face_properties: dict[str, np.ndarray] = field(default_factory=dict)


def read_mesh(path: str | Path) -> MeshFile:
    """Read a mesh file and check it.

    Raises:
        InputError: missing, unknown or unreadable file, no faces, or what `TriangleMesh` refuses.
    """
    raw = read_raw_mesh(path)
    try:
        mesh = TriangleMesh(raw.vertices, raw.faces)
    except InputError as error:
        raise InputError(
            f"{path}: {error.subject}", expected=error.expected, received=error.received, remedy=error.remedy
        ) from None
    return MeshFile(mesh, raw.vertex_colors, raw.vertex_properties, raw.face_properties)


def read_raw_mesh(path: str | Path) -> RawMesh:
    """Read the arrays of a mesh file, unchecked but for a file that holds no triangle mesh at all."""
    path = Path(path)
    if not path.is_file():
        raise InputError("mesh file", expected="an existing file", received=str(path))
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"mesh file {path}", expected=f"one of {', '.join(SUFFIXES)}", received=path.suffix or "none")
    if path.suffix.lower() in (".npz", ".pkl"):
        raw = _read_arrays(path)
    else:
        raw = _read_with_trimesh(path)
    if not len(raw.faces) or not len(raw.vertices):
        raise InputError(
            f"mesh file {path}",
            expected="a triangle mesh",
            received=f"{len(raw.vertices)} vertices, {len(raw.faces)} faces",
            remedy="export the surface, not the point cloud",
        )
    return raw


def _read_arrays(path: Path) -> RawMesh:
    if path.suffix.lower() == ".npz":
        with np.load(path, allow_pickle=False) as data:
            values = {key: data[key] for key in data.files}
    else:
        from smplxpp.core.safe_pickle import safe_load

        loaded = safe_load(path)
        values = loaded if isinstance(loaded, dict) else {}
    keys = {"vertices": ("vertices", "verts", "v"), "faces": ("faces", "f")}
    found = {name: next((values[k] for k in names if k in values), None) for name, names in keys.items()}
    if found["vertices"] is None or found["faces"] is None:
        raise InputError(
            f"mesh file {path}", expected="arrays `vertices` and `faces`", received=f"keys {sorted(map(str, values))}"
        )
    colors = values.get("vertex_colors", values.get("colors"))
    if colors is not None:
        colors = np.asarray(colors)[:, :3]
        if colors.dtype.kind == "f":
            colors = np.clip(colors * (255.0 if colors.max() <= 1.0 else 1.0) + 0.5, 0, 255)
        colors = colors.astype(np.uint8)
    return RawMesh(np.asarray(found["vertices"], np.float64), np.asarray(found["faces"]).astype(np.int64), colors)


def _read_with_trimesh(path: Path) -> RawMesh:
    import trimesh

    try:
        loaded = trimesh.load(path, process=False, maintain_order=True, force="mesh")
    except Exception as error:  # noqa: BLE001  a parser may raise anything on a broken file
        raise InputError(
            f"mesh file {path}", expected="a readable mesh", received=f"{type(error).__name__}: {error}"
        ) from None
    if not isinstance(loaded, trimesh.Trimesh):
        raise InputError(f"mesh file {path}", expected="a triangle mesh", received=type(loaded).__name__)
    colors = None
    visual = loaded.visual
    if isinstance(visual, trimesh.visual.ColorVisuals):
        if visual.kind == "vertex":
            colors = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
    elif visual is not None and visual.uv is not None and len(visual.uv) == len(loaded.vertices):
        colors = np.asarray(visual.to_color().vertex_colors)[:, :3].astype(np.uint8)
    vertex_properties, face_properties = _ply_properties(loaded)
    return RawMesh(
        np.asarray(loaded.vertices, np.float64),
        np.asarray(loaded.faces, np.int64),
        colors,
        vertex_properties,
        face_properties,
    )


def _ply_properties(loaded) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The extra per-vertex and per-face scalars of a PLY file, which trimesh keeps raw."""
    known = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "vertex_indices", "vertex_index"}
    out: list[dict[str, np.ndarray]] = []
    for element, count in (("vertex", len(loaded.vertices)), ("face", len(loaded.faces))):
        data = loaded.metadata.get("_ply_raw", {}).get(element, {}).get("data", {})
        names = data.dtype.names or () if isinstance(data, np.ndarray) else data
        arrays = {name: np.asarray(data[name]).reshape(-1) for name in names if name not in known}
        out.append({name: a for name, a in arrays.items() if len(a) == count and a.dtype.kind in "iuf"})
    return out[0], out[1]


def write_ply(
    path: str | Path,
    mesh: TriangleMesh,
    *,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
    vertex_properties: dict[str, np.ndarray] | None = None,
    face_properties: dict[str, np.ndarray] | None = None,
) -> None:
    """Write a binary little-endian PLY, whole or not at all; coordinates as float32."""
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
