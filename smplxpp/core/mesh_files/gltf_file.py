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
from smplxpp.core.files.json_file import as_integer, as_object
from smplxpp.core.mesh_files.gltf_colors import primitive_colors, primitive_texture
from smplxpp.core.mesh_files.gltf_compression import DRACO
from smplxpp.core.mesh_files.gltf_document import GltfDocument
from smplxpp.core.mesh_files.gltf_skins import Binding, Bindings, Node, read_influences, world_nodes
from smplxpp.core.mesh_files.raw_mesh import FacePictures, RawMesh, blended, require_indices, warn
from smplxpp.core.mesh_files.texture import MISSING_GRAY

# Modes of primitives: triangles, triangle strip, triangle fan. Lower ones are points and lines.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def read_gltf(path: Path) -> RawMesh:
    """Read a `.gltf` or `.glb` file as one mesh; skinned meshes stand as the file's joints pose them.

    Colours are the product of the base colour's texture, `COLOR_0` and the base colour, as far as present. Lines and
    points are left out with a warning; morph targets and animations without one.

    Raises:
        InputError: no glTF 2.0, data outside the file or damaged, a node with two parents.
        MissingExtraError: Draco's or meshoptimizer's compression without the extra `gltf`.
    """
    document = GltfDocument(path)
    nodes = {node.index: node for node in world_nodes(document)}
    parts = _Parts(document, Bindings(document, nodes))
    for node in nodes.values():
        if "mesh" in node.json:
            parts.add_node(node, document.entry("meshes", node.json["mesh"]))
    return parts.joined()


class _Parts:
    """Accumulates primitives into one mesh, with limits on its size."""

    def __init__(self, document: GltfDocument, bindings: Bindings) -> None:
        self._document, self._bindings = document, bindings
        self._bound: list[Float64[np.ndarray, "n 3"]] = []
        self._influences: list[tuple[Int64[np.ndarray, "n k"], Float64[np.ndarray, "n k"]]] = []
        self._names: list[str] = []
        self._part: list[Int64[np.ndarray, " m"]] = []
        self._vertices: list[Float64[np.ndarray, "n 3"]] = []
        self._colors: list[UInt8[np.ndarray, "n 3"]] = []
        self._colored: list[np.ndarray] = []
        self._faces: list[Int64[np.ndarray, "m 3"]] = []
        self._starts: list[int] = []
        self._uv: list[Float32[np.ndarray, "m 3 2"]] = []
        self._picture: list[Int64[np.ndarray, " m"]] = []
        self._load: list[tuple[tuple[str, str], Callable[[], np.ndarray]]] = []
        self._count = self._made = self._visits = self._left_out = 0

    def add_node(self, node: Node, mesh: dict[str, Any]) -> None:
        """Append the primitives of a node's mesh."""
        document = self._document
        binding = self._bindings.of(node)
        name = node.json.get("name", mesh.get("name"))
        self._names.append(name if isinstance(name, str) and name else f"node {node.index}")
        # Primitives of one mesh often share an accessor of positions, which is then added once.
        shared: dict[int, int] = {}
        for primitive in document.items(mesh, "primitives"):
            self._add(as_object(primitive, subject=f"{document.subject}: primitive"), node.world, binding, shared)

    def _add(
        self,
        primitive: dict[str, Any],
        world: Float64[np.ndarray, "4 4"],
        binding: Binding | None,
        shared: dict[int, int],
    ) -> None:
        """Append a primitive.

        Args:
            primitive: JSON object of the primitive.
            world: transform from the node to the world, for meshes without a skin.
            binding: what moves the node's mesh; None: nothing.
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
        compressed = document.part(document.part(primitive, "extensions"), DRACO)
        # A file may hold the same geometry without compression for readers that do not know the extension.
        if compressed and "bufferView" not in document.entry("accessors", position):
            document.decompress(attributes, primitive.get("indices"), compressed)
        if position not in shared:
            shared[position] = self._add_vertices(attributes, position, world, binding)
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
        mirrored = (binding is None or not binding.skinned) and np.linalg.det(world[:3, :3]) < 0
        faces = faces[:, ::-1] if mirrored else faces
        self._faces.append(faces + self._starts[part])
        self._part.append(np.full(len(faces), len(self._names) - 1))
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
        binding: Binding | None,
    ) -> int:
        """Append the vertices of an accessor in world coordinates; returns the index of their part."""
        points = self._document.accessor(position).astype(np.float64)
        if points.shape[1] != 3:
            raise InputError(f"{self._document.subject}: POSITION", expected="three coordinates", received="others")
        self._charge(len(points))
        influences = read_influences(self._document, attributes, len(points), binding)
        self._bound.append(points)
        self._influences.append(influences)
        with np.errstate(all="ignore"):  # overflowing coordinates become infinite, and are refused by the callers
            if binding is None or not binding.skinned:
                points = points @ world[:3, :3].T + world[:3, 3]
            else:
                points = blended(points, influences[0] - binding.first, influences[1], binding.matrices)
        self._starts.append(self._count)
        self._count += len(points)
        self._vertices.append(points)
        self._colors.append(np.full((len(points), 3), MISSING_GRAY, np.uint8))
        self._colored.append(np.zeros(len(points), bool))
        return len(self._vertices) - 1

    def _charge(self, elements: int) -> None:
        """Refuse a small file that repeats its meshes until memory is exhausted.

        A file may contain a mesh once and show it many times. Allowed are as many vertices and faces as the file has
        bytes after decompression, because Draco packs dense scans into less than a byte a vertex or face, or a million,
        and a thousand million reads of shared vertices.
        """
        self._made += elements
        most = max(1_000_000, self._document.held_bytes)
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
        return RawMesh(
            np.concatenate(self._vertices),
            np.concatenate(self._faces),
            colors,
            pictures=pictures,
            part_names=tuple(self._names),
            face_part=np.concatenate(self._part),
            rig=self._bindings.rig(self._bound, self._influences),
        )


def _triangles(indices: Int64[np.ndarray, " n"], mode: int) -> Int64[np.ndarray, "m 3"]:
    """Convert the indices of triangles, a strip or a fan to faces; every second face of a strip is reversed."""
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    k = np.arange(max(len(indices) - 2, 0))
    if mode == _FAN:
        return indices[np.stack([np.zeros_like(k), k + 1, k + 2], axis=1)]
    odd = k % 2
    return indices[np.stack([k, k + 1 + odd, k + 2 - odd], axis=1)]
