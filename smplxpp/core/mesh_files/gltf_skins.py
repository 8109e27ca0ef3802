"""Read the nodes and skins of a glTF file: where meshes stand, how joints pose them, and the rig that does it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_numbers
from smplxpp.core.mesh_files.gltf_document import GltfDocument
from smplxpp.core.mesh_files.raw_mesh import FileRig, require_indices

_MOVING = {"matrix", "translation", "rotation", "scale"}


@dataclass(frozen=True, eq=False)
class Node:
    """A node of the scene.

    Attributes:
        json: its JSON object.
        index: in the document.
        parent: index of its parent in the document, -1 for a root.
        world: transform to the world.
    """

    json: dict[str, Any]
    index: int
    parent: int
    world: Float64[np.ndarray, "4 4"]


def world_nodes(document: GltfDocument) -> list[Node]:
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
    stack = [(index, -1, np.eye(4)) for index in reversed(roots)]
    while stack:
        index, above, parent = stack.pop()
        node = document.entry("nodes", index)
        if index in seen:
            raise InputError(f"{document.subject}: nodes", expected="a tree", received=f"node {index} twice")
        seen.add(index)
        with np.errstate(all="ignore"):
            world = parent @ _local(document, node) if _MOVING & node.keys() else parent
        found.append(Node(node, index, above, world))
        stack += [(child, index, world) for child in reversed(document.items(node, "children"))]
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


@dataclass(frozen=True, eq=False)
class Binding:
    """What moves the vertices of a mesh.

    Attributes:
        matrices: (C, 4, 4) joint matrices, from the vertices as stored to the world.
        first: column of the first of them among those of the file.
        skinned: whether a skin does; else its one matrix is the node's, which hangs on a joint.
    """

    matrices: Float64[np.ndarray, "C 4 4"]
    first: int
    skinned: bool


class Bindings:
    """All bindings of a file; a skin's matrices are computed once, even if several nodes use it.

    Args:
        document: the file.
        nodes: of its scene, by their indices, parents before children.

    Raises:
        InputError: a skin whose joints are not in the scene, or whose matrices do not fit.
    """

    def __init__(self, document: GltfDocument, nodes: dict[int, Node]) -> None:
        self._document, self._nodes = document, nodes
        self._skins: dict[int, Binding] = {}
        # Node and inverse bind matrix of each column of the weights.
        self._columns: list[tuple[int, Float64[np.ndarray, "4 4"]]] = []
        self._joints: set[int] = set()
        for k in range(len(document.items(document.json, "skins"))):
            self._joints |= {j for j in document.items(document.entry("skins", k), "joints") if isinstance(j, int)}

    def of(self, node: Node) -> Binding | None:
        """Return what moves a node's mesh: its skin, or a joint that it hangs on; None if nothing does."""
        if "skin" in node.json:
            skin = self._document.number(node.json, "skin")
            if skin not in self._skins:
                self._skins[skin] = self._add(*self._skin(skin), skinned=True)
            return self._skins[skin]
        above: Node | None = node
        while above is not None and above.index not in self._joints:
            above = self._nodes.get(above.parent)
        # A joint that is squeezed flat carries nothing.
        if above is None or not abs(float(np.linalg.det(above.world[:3, :3]))) > 0.0:
            return None
        return self._add([above.index], (np.linalg.inv(above.world) @ node.world)[None], skinned=False)

    def _add(self, joints: list[int], binds: Float64[np.ndarray, "C 4 4"], *, skinned: bool) -> Binding:
        first = len(self._columns)
        self._columns += zip(joints, binds, strict=True)
        # A skin's joint matrix is G_j B_j: from the bind pose to the joint, then to the world. The node's own transform
        # is ignored (section 3.7.3.3).
        with np.errstate(all="ignore"):
            return Binding(np.stack([self._nodes[j].world for j in joints]) @ binds, first, skinned)

    def _skin(self, index: int) -> tuple[list[int], Float64[np.ndarray, "C 4 4"]]:
        """Return the nodes of a skin's joints, and its inverse bind matrices."""
        document = self._document
        skin = document.entry("skins", index)
        joints = document.items(skin, "joints")
        if not joints or any(not isinstance(joint, int) or joint not in self._nodes for joint in joints):
            raise InputError(f"{document.subject}: skin", expected="joints of the scene", received="others")
        if "inverseBindMatrices" not in skin:
            return joints, np.tile(np.eye(4), (len(joints), 1, 1))
        bind = document.accessor(skin["inverseBindMatrices"])
        if bind.shape[1] != 16 or len(bind) < len(joints):
            raise InputError(f"{document.subject}: skin", expected="a matrix a joint", received="others")
        # Column-major matrices, hence the transpose of the last two axes.
        return joints, bind[: len(joints)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)

    def rig(
        self,
        bound: list[np.ndarray],
        influences: list[tuple[np.ndarray, np.ndarray]],
    ) -> FileRig | None:
        """Return the file's rig; None for a file without a skin.

        Args:
            bound: vertices as stored, (n, 3) a part.
            influences: columns and weights of each part's vertices, (n, k).
        """
        if not self._skins:
            return None
        # Joints in the order of the scene, parents first; a joint's parent is the nearest joint above it.
        used = {joint for joint, _ in self._columns}
        order = [index for index in self._nodes if index in used or index in self._joints]
        place = {index: k for k, index in enumerate(order)}
        parents = []
        for index in order:
            above = self._nodes[index].parent
            while above >= 0 and above not in place:
                above = self._nodes[above].parent
            parents.append(place.get(above, -1))
        names = [self._nodes[index].json.get("name") for index in order]
        most = max(indices.shape[1] for indices, _ in influences)
        return FileRig(
            names=tuple(
                name if isinstance(name, str) else f"joint {index}" for name, index in zip(names, order, strict=True)
            ),
            parents=np.array(parents, dtype=np.int64),
            world=np.stack([self._nodes[index].world for index in order]),
            column_joint=np.array([place[joint] for joint, _ in self._columns], dtype=np.int64),
            inverse_bind=np.stack([bind for _, bind in self._columns]),
            columns=np.concatenate([np.pad(i, ((0, 0), (0, most - i.shape[1]))) for i, _ in influences]),
            weights=np.concatenate([np.pad(w, ((0, 0), (0, most - w.shape[1]))) for _, w in influences]),
            bound=np.concatenate(bound),
        )


def read_influences(
    document: GltfDocument, attributes: dict[str, Any], count: int, binding: Binding | None
) -> tuple[Int64[np.ndarray, "n k"], Float64[np.ndarray, "n k"]]:
    """Return the columns and weights, as stored, of `count` vertices: sets of four, JOINTS_0, JOINTS_1, ...

    Raises:
        InputError: sets that do not fit the vertices, or joints that the skin has not.
    """
    if binding is None:
        return np.zeros((count, 1), np.int64), np.zeros((count, 1))
    if not binding.skinned:
        return np.full((count, 1), binding.first), np.ones((count, 1))
    columns, weights = [np.zeros((count, 0), np.int64)], [np.zeros((count, 0))]
    most_sets = 16  # 64 joints a vertex; more are a damaged file's, and would fill the memory
    while f"JOINTS_{len(columns) - 1}" in attributes and f"WEIGHTS_{len(columns) - 1}" in attributes:
        k = len(columns) - 1
        if k == most_sets:
            raise InputError(
                f"{document.subject}: skin", expected=f"at most {most_sets} sets of joints", received="more"
            )
        index, weight = (document.accessor(attributes[f"{name}_{k}"]) for name in ("JOINTS", "WEIGHTS"))
        if index.shape != weight.shape or len(index) != count or index.dtype.kind not in "iu":
            raise InputError(f"{document.subject}: skin", expected="joints and weights a vertex", received="others")
        require_indices(index, len(binding.matrices), subject=document.subject, kind="joints")
        columns.append(index.astype(np.int64) + binding.first)
        weights.append(weight.astype(np.float64))
    return np.concatenate(columns, axis=1), np.concatenate(weights, axis=1)
