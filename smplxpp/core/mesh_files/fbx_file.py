"""Read meshes of FBX files through assimp: all meshes of the scene as one, in metres, +Y up, coloured by textures.

FBX states its unit (`UnitScaleFactor`, centimetres) and its axes (`UpAxis`, `FrontAxis`, `CoordAxis`) in its global
settings, binary or as text; assimp's Python bindings do not pass them on, so that they are read here.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.lazy import import_extra
from smplxpp.core.mesh_files.raw_mesh import RawMesh, warn
from smplxpp.core.mesh_files.texture import MISSING_GRAY, TextureCache, sample_texture

_BINARY = b"Kaydara FBX Binary"
_DIFFUSE, _BASE_COLOR = 1, 12  # assimp's types of textures


def read_fbx(path: Path) -> RawMesh:
    """Read the meshes of an FBX file, of skinned ones the shape that they are bound in.

    Raises:
        MissingExtraError: assimp's bindings are not installed.
        InputError: a file that assimp refuses, or one without a triangle.
    """
    purpose = f"reading {path.name} (or convert it to GLB with a 3D program)"
    assimp_py = import_extra("assimp_py", extra="fbx", purpose=purpose, named="assimp-py")
    subject = f"mesh file {path}"
    most_bytes = 1 << 31
    data = read_bytes(path, subject="mesh file", most=most_bytes)
    if not (data.startswith(_BINARY) or b"FBXHeaderExtension" in data[:4096]):
        raise InputError(subject, expected="an FBX file", received=f"{data[:20]!r}")
    flags = assimp_py.Process_Triangulate | assimp_py.Process_JoinIdenticalVertices
    try:
        scene = assimp_py.import_file(str(path), flags)
    except (RuntimeError, ValueError, OSError) as error:
        if "triangulated" in str(error):  # assimp's word for faces of one corner or two
            raise InputError(
                subject,
                expected="faces of three corners and more",
                received="loose points or lines beside them",
                remedy="in Blender: Select > All by Trait > Loose Geometry, delete, and export again",
            ) from None
        raise InputError(
            subject,
            expected="an FBX file that assimp reads, version 7.1 or later",
            received=str(error)[:200] or type(error).__name__,
            remedy="export it again, as FBX 7.4 or as GLB",
        ) from None
    metres_per_centimetre = 0.01
    # File to metres, +Y up; the scene's root holds assimp's own idea of the axes, which differs between its versions.
    to_metres = _axes(data) * _number(data, b"UnitScaleFactor", 1.0) * metres_per_centimetre
    pictures = TextureCache(subject)
    vertices, faces, colors, count = [], [], [], 0
    for index, placed in _instances(scene.root_node):
        mesh = scene.meshes[index]
        points = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        corners = np.array(mesh.indices, dtype=np.int64).reshape(-1)
        if mesh.num_faces * 3 != len(corners) or not len(corners):
            continue
        vertices.append((points @ placed[:3, :3].T + placed[:3, 3]) @ to_metres.T)
        faces.append(corners.reshape(-1, 3) + count)
        colors.append(_colors(path, mesh, scene.materials, pictures))
        count += len(points)
    if not vertices:
        raise InputError(subject, expected="a triangle mesh", received="none in the scene")
    joined = None
    if any(found is not None for found in colors):
        grey = [np.full((len(points), 3), MISSING_GRAY, np.uint8) for points in vertices]
        joined = np.concatenate([g if c is None else c for g, c in zip(grey, colors, strict=True)])
    return RawMesh(np.concatenate(vertices), np.concatenate(faces), joined)


def _instances(root: Any) -> Iterator[tuple[int, Float64[np.ndarray, "4 4"]]]:
    """Yield every mesh of the scene by its index, with the transform of its node, without the root's own."""
    stack = [(root, np.eye(4), 0)]
    # Nodes above one another; skeletons have fewer than 50.
    deepest = 200
    while stack:
        node, above, depth = stack.pop()
        own = np.array(node.transformation, dtype=np.float64).reshape(4, 4)
        placed = above if depth == 0 else above @ own
        for index in node.mesh_indices:
            yield index, placed
        if depth < deepest:
            stack.extend((child, placed, depth + 1) for child in node.children)


def _colors(path: Path, mesh: Any, materials: list[dict], pictures: TextureCache) -> UInt8[np.ndarray, "N 3"] | None:
    """Return the colours of a mesh's vertices by its texture or its material's colour; None without either."""
    material = materials[mesh.material_index] if mesh.material_index < len(materials) else {}
    textures = material.get("TEXTURES") or {}
    names = textures.get(_BASE_COLOR) or textures.get(_DIFFUSE)
    if names and mesh.texcoords:
        picture = pictures.load(path, str(names[0]))
        uv = np.array(mesh.texcoords[0], dtype=np.float64).reshape(mesh.num_vertices, -1)[:, :2]
        return None if picture is None else sample_texture(picture, uv)
    if material.get("NAME") == "DefaultMaterial":  # assimp's own, of a mesh without any
        return None
    diffuse = np.asarray(material.get("COLOR_DIFFUSE", ()), dtype=np.float64)
    if diffuse.size < 3 or not np.isfinite(diffuse[:3]).all():
        return None
    color = np.rint(255 * np.clip(diffuse[:3], 0, 1)).astype(np.uint8)
    return np.repeat(color[None], mesh.num_vertices, axis=0)


def _axes(data: bytes) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation from the file's axes to x right, y up, z to the front; the identity where they are none."""
    rows = np.zeros((3, 3))
    for row, (name, default) in enumerate(((b"CoordAxis", 0), (b"UpAxis", 1), (b"FrontAxis", 2))):
        axis = int(_number(data, name, default))
        if axis not in (0, 1, 2):
            return np.eye(3)
        rows[row, axis] = 1.0 if _number(data, name + b"Sign", 1.0) >= 0 else -1.0
    if abs(np.linalg.det(rows) - 1.0) > 1e-9:
        warn("FBX axes that are no right-handed frame are taken for x right, y up: state the axis with --up")
        return np.eye(3)
    return rows


def _number(data: bytes, name: bytes, default: float) -> float:
    """Return a number of the global settings; the default where the file does not state it."""
    text = re.search(rb'"%s"\s*,(?:\s*"[^"]*"\s*,){3}\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)' % name, data)
    if text is not None:
        return float(text[1])
    # Binary: the name, three texts (type, label, flags), then I or D and the number; a text is S, its length, bytes.
    at = data.find(struct.pack("<cI", b"S", len(name)) + name)
    if at < 0:
        return default
    at += 5 + len(name)
    for _ in range(3):
        if data[at : at + 1] != b"S" or at + 5 > len(data):
            return default
        at += 5 + struct.unpack_from("<I", data, at + 1)[0]
    kinds = {b"I": "<i", b"D": "<d", b"L": "<q", b"F": "<f"}
    kind = kinds.get(data[at : at + 1])
    if kind is None or at + 9 > len(data):
        return default
    value = float(struct.unpack_from(kind, data, at + 1)[0])
    return value if np.isfinite(value) else default
