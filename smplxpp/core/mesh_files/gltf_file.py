"""Read glTF and GLB meshes: all primitives of the scene, concatenated in world coordinates.

Vertices keep the order of their accessors, nodes come depth first; primitives of a node that share an accessor of
positions share its vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_numbers, as_object
from smplxpp.core.mesh_files.gltf_colors import primitive_colors, primitive_texture
from smplxpp.core.mesh_files.gltf_document import GltfDocument, compression_error
from smplxpp.core.mesh_files.raw_mesh import FacePictures, RawMesh, require_indices, warn
from smplxpp.core.mesh_files.texture import MISSING_GRAY

# Modes of primitives: triangles, triangle strip, triangle fan. Lower ones are points and lines.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MOVING = {"matrix", "translation", "rotation", "scale"}


def read_gltf(path: Path) -> RawMesh:
    """Read a `.gltf` or `.glb` file as one mesh; skinned meshes stand as the file's joints pose them.

    Colours are the product of the base colour's texture, `COLOR_0` and the base colour, as far as present. Lines and
    points are left out with a warning; morph targets and animations without one.

    Raises:
        InputError: no glTF 2.0, Draco or meshopt compression, data outside the file, a node with two parents.
    """
    document = GltfDocument(path)
    parts = _Parts(document)
    nodes = _world_nodes(document)
    worlds = {id(node): world for node, world in nodes}
    skins: dict[int, Float64[np.ndarray, "J 4 4"]] = {}
    for node, world in nodes:
        if "mesh" in node:
            mesh = document.entry("meshes", node["mesh"])
            joints = None
            # The joints' matrices of a skin are computed once, even if several nodes use it.
            if "skin" in node:
                skin = document.number(node, "skin")
                if skin not in skins:
                    skins[skin] = _joint_matrices(document, skin, worlds)
                joints = skins[skin]
            # Primitives of one mesh often share an accessor of positions, which is then added once.
            shared: dict[int, int] = {}
            for primitive in document.items(mesh, "primitives"):
                parts.add(as_object(primitive, subject=f"{document.subject}: primitive"), world, joints, shared)
    return parts.joined()


class _Parts:
    """Accumulates primitives into one mesh, with limits on its size."""

    def __init__(self, document: GltfDocument) -> None:
        self._document = document
        self._vertices: list[Float64[np.ndarray, "n 3"]] = []
        self._colors: list[UInt8[np.ndarray, "n 3"]] = []
        self._colored: list[np.ndarray] = []
        self._faces: list[Int64[np.ndarray, "m 3"]] = []
        self._starts: list[int] = []
        self._uv: list[Float32[np.ndarray, "m 3 2"]] = []
        self._picture: list[Int64[np.ndarray, " m"]] = []
        self._load: list[tuple[tuple[str, str], Callable[[], np.ndarray]]] = []
        self._count = self._made = self._visits = self._left_out = 0

    def add(
        self,
        primitive: dict[str, Any],
        world: Float64[np.ndarray, "4 4"],
        joints: Float64[np.ndarray, "J 4 4"] | None,
        shared: dict[int, int],
    ) -> None:
        """Append a primitive.

        Args:
            primitive: JSON object of the primitive.
            world: transform from the node to the world, for meshes without a skin.
            joints: joint matrices of the node's skin; None: not skinned.
            shared: parts of the node's earlier primitives by their accessor of positions; extended here.
        """
        document, subject = self._document, self._document.subject
        mode = as_integer(primitive.get("mode", _TRIANGLES), subject=f"{subject}: mode", least=0, most=6)
        attributes = document.part(primitive, "attributes")
        if mode < _TRIANGLES or "POSITION" not in attributes:
            # Points and lines have no surface.
            self._left_out += 1
            return
        position = document.number(attributes, "POSITION")
        draco = "KHR_draco_mesh_compression"
        if draco in document.part(primitive, "extensions") and "bufferView" not in document.entry(
            "accessors", position
        ):
            raise compression_error(subject, draco)
        if position not in shared:
            shared[position] = self._add_vertices(attributes, position, world, joints)
        # Indices into the part's vertices; without any, the vertices follow each other.
        part = shared[position]
        count = len(self._vertices[part])
        self._visits += count
        self._charge(0)
        if "indices" in primitive:
            indices = document.accessor(primitive["indices"])
            if indices.dtype.kind not in "iu" or indices.shape[1] != 1:
                raise InputError(f"{subject}: indices", expected="whole numbers", received="others")
            indices = indices.reshape(-1).astype(np.int64)
            require_indices(indices, count, subject=subject, kind="indices")
        else:
            indices = np.arange(count, dtype=np.int64)
        # A reflection turns faces inside out, so their corners are reversed.
        faces = _triangles(indices, mode)
        mirrored = joints is None and np.linalg.det(world[:3, :3]) < 0
        faces = faces[:, ::-1] if mirrored else faces
        self._faces.append(faces + self._starts[part])
        self._charge(len(faces))
        texture = primitive_texture(document, primitive, count)
        self._picture.append(np.full(len(faces), -1 if texture is None else len(self._load)))
        self._uv.append(np.zeros((len(faces), 3, 2), np.float32) if texture is None else texture[0][faces])
        self._load += [] if texture is None else [texture[1:]]
        # A vertex that several primitives share keeps the colour of the first one that colours it.
        used = np.zeros(count, bool)
        used[indices] = True
        used &= ~self._colored[part]
        colors = primitive_colors(document, primitive, count)
        if colors is not None:
            self._colors[part][used] = colors[used]
            self._colored[part] |= used

    def _add_vertices(
        self,
        attributes: dict[str, Any],
        position: int,
        world: Float64[np.ndarray, "4 4"],
        joints: Float64[np.ndarray, "J 4 4"] | None,
    ) -> int:
        """Append the vertices of an accessor in world coordinates; returns the index of their part."""
        points = self._document.accessor(position).astype(np.float64)
        if points.shape[1] != 3:
            raise InputError(f"{self._document.subject}: POSITION", expected="three coordinates", received="others")
        self._charge(len(points))
        with np.errstate(all="ignore"):  # overflowing coordinates become infinite, and are refused by the callers
            if joints is None:
                points = points @ world[:3, :3].T + world[:3, 3]
            else:
                points = _skinned(self._document, attributes, points, joints)
        self._starts.append(self._count)
        self._count += len(points)
        self._vertices.append(points)
        self._colors.append(np.full((len(points), 3), MISSING_GRAY, np.uint8))
        self._colored.append(np.zeros(len(points), bool))
        return len(self._vertices) - 1

    def _charge(self, elements: int) -> None:
        """Refuse a small file that repeats its meshes until memory is exhausted.

        A file may contain a mesh once and show it many times. Allowed are as many vertices and faces as the file has
        bytes, or a million, and a thousand million reads of shared vertices.
        """
        self._made += elements
        most = max(1_000_000, self._document.size + self._document.file_bytes)
        if self._made > most or self._visits > 1_000_000_000:
            raise InputError(
                self._document.subject,
                expected=f"at most {most} vertices and faces from a file of this size",
                received="nodes or primitives that repeat its meshes more often",
            )

    def joined(self) -> RawMesh:
        """Return all parts as one mesh."""
        if self._left_out:
            warn(f"{self._document.subject}: {self._left_out} primitives of points or lines are left out")
        if not self._vertices:
            return RawMesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
        colors = np.concatenate(self._colors) if any(mask.any() for mask in self._colored) else None
        pictures = None
        if self._load:
            wraps, load = zip(*self._load, strict=True)
            pictures = FacePictures(np.concatenate(self._uv), np.concatenate(self._picture), load, wraps)
        return RawMesh(np.concatenate(self._vertices), np.concatenate(self._faces), colors, pictures=pictures)


def _triangles(indices: Int64[np.ndarray, " n"], mode: int) -> Int64[np.ndarray, "m 3"]:
    """Convert the indices of triangles, a strip or a fan to faces; every second face of a strip is reversed."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    k = np.arange(max(len(indices) - 2, 0))
    if mode == _FAN:
        return indices[np.stack([np.zeros_like(k), k + 1, k + 2], axis=1)]
    odd = k % 2
    return indices[np.stack([k, k + 1 + odd, k + 2 - odd], axis=1)]


def _world_nodes(document: GltfDocument) -> list[tuple[dict[str, Any], Float64[np.ndarray, "4 4"]]]:
    """Return the nodes of the scene, depth first, with their transforms to the world."""
    # The default scene; without scenes every node without a parent is a root.
    scenes = document.items(document.json, "scenes")
    if scenes:
        roots = document.items(document.entry("scenes", document.json.get("scene", 0)), "nodes")
    else:
        nodes = [document.entry("nodes", k) for k in range(len(document.items(document.json, "nodes")))]
        below = {child for node in nodes for child in document.items(node, "children") if isinstance(child, int)}
        roots = [k for k in range(len(nodes)) if k not in below]
    found = []
    seen: set[int] = set()
    # Reversed, so that the stack yields nodes in the file's order.
    stack = [(index, np.eye(4)) for index in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = document.entry("nodes", index)
        if index in seen:
            raise InputError(f"{document.subject}: nodes", expected="a tree", received=f"node {index} twice")
        seen.add(index)
        with np.errstate(all="ignore"):
            world = parent @ _local(document, node) if _MOVING & node.keys() else parent
        found.append((node, world))
        stack += [(child, world) for child in reversed(document.items(node, "children"))]
    return found


def _local(document: GltfDocument, node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """Return the transform of a node to its parent: its matrix, or translation times rotation times scale."""
    subject = f"{document.subject}: node"
    # glTF stores matrices column by column.
    if "matrix" in node:
        return as_numbers(node["matrix"], (16,), subject=f"{subject} matrix").reshape(4, 4).T
    # Quaternions are (x, y, z, w), unit by the specification.
    x, y, z, w = as_numbers(node.get("rotation", [0, 0, 0, 1]), (4,), subject=f"{subject} rotation")
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    out = np.eye(4)
    # R S: each column of the rotation is scaled.
    out[:3, :3] = rotation * as_numbers(node.get("scale", [1, 1, 1]), (3,), subject=f"{subject} scale")
    out[:3, 3] = as_numbers(node.get("translation", [0, 0, 0]), (3,), subject=f"{subject} translation")
    return out


def _joint_matrices(
    document: GltfDocument, index: int, worlds: dict[int, Float64[np.ndarray, "4 4"]]
) -> Float64[np.ndarray, "J 4 4"]:
    """Return the joint matrices of a skin: transforms to the world times inverse bind matrices.

    Args:
        document: file of the skin.
        index: index of the skin.
        worlds: transforms of the nodes to the world, by the identity of their JSON objects.
    """
    skin = document.entry("skins", index)
    joints = document.items(skin, "joints")
    # A skin's joint matrix is G_j B_j: from the bind pose to the joint, then to the world. The node's own transform
    # is ignored (section 3.7.3.3).
    try:
        out = np.stack([worlds[id(document.entry("nodes", joint))] for joint in joints])
    except (KeyError, ValueError):
        raise InputError(f"{document.subject}: skin", expected="joints of the scene", received="others") from None
    if "inverseBindMatrices" in skin:
        bind = document.accessor(skin["inverseBindMatrices"])
        if bind.shape[1] != 16 or len(bind) < len(out):
            raise InputError(f"{document.subject}: skin", expected="a matrix a joint", received="others")
        with np.errstate(all="ignore"):
            # Column-major matrices, hence the transpose of the last two axes.
            out = out @ bind[: len(out)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
    return out


def _skinned(
    document: GltfDocument,
    attributes: dict[str, Any],
    points: Float64[np.ndarray, "n 3"],
    joints: Float64[np.ndarray, "J 4 4"],
) -> Float64[np.ndarray, "n 3"]:
    """Pose vertices by linear blend skinning; weights are normalised, and vertices without weights stay."""
    out = np.zeros_like(points)
    total = np.zeros((len(points), 1))
    # Sets of four influences each: JOINTS_0, JOINTS_1, ...
    k = 0
    while f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes:
        index, weights = (document.accessor(attributes[f"{name}_{k}"]) for name in ("JOINTS", "WEIGHTS"))
        if index.shape != weights.shape or len(index) != len(points) or index.dtype.kind not in "iu":
            raise InputError(f"{document.subject}: skin", expected="joints and weights a vertex", received="others")
        require_indices(index, len(joints), subject=document.subject, kind="joints")
        for joint, weight in zip(index.T, weights.T.astype(np.float64), strict=True):
            moved = np.einsum("nij,nj->ni", joints[joint, :3, :3], points) + joints[joint, :3, 3]
            out += weight[:, None] * moved
            total += weight[:, None]
        k += 1
    # Weights are divided by their sum, because quantised ones do not sum to one.
    return np.divide(out, total, out=points.copy(), where=total > 0)
