"""A small reader of GLB files that skins as the glTF specification says, with nothing of the writer in it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

_DTYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GlbReader:
    """The JSON of a file and its arrays."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert kind == b"BIN\0" and binary_size % 4 == 0
        self.binary = data[28 + size :]
        assert len(self.binary) == binary_size

    def array(self, index: int) -> np.ndarray:
        """(N, width) of an accessor."""
        accessor = self.json["accessors"][index]
        dtype, width, count = _DTYPES[accessor["componentType"]], _WIDTHS[accessor["type"]], accessor["count"]
        if "bufferView" in accessor:
            offset = accessor.get("byteOffset", 0)
            out = self._view(accessor["bufferView"], dtype, count * width, offset).reshape(count, width).copy()
        else:
            out = np.zeros((count, width), dtype)
        if sparse := accessor.get("sparse"):
            where, values, n = sparse["indices"], sparse["values"], sparse["count"]
            rows = self._view(where["bufferView"], _DTYPES[where["componentType"]], n, where.get("byteOffset", 0))
            out[rows] = self._view(values["bufferView"], dtype, n * width, values.get("byteOffset", 0)).reshape(n, -1)
        if accessor.get("normalized"):
            return out / np.iinfo(out.dtype).max
        return out

    def mesh(self, name: str) -> tuple[dict, dict]:
        """A mesh and its only primitive."""
        mesh = next(m for m in self.json["meshes"] if m["name"] == name)
        (primitive,) = mesh["primitives"]
        return mesh, primitive

    def influences(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(N, K) joints and weights of a part, all sets side by side."""
        attributes = self.mesh(name)[1]["attributes"]
        sets = range(sum(key.startswith("JOINTS_") for key in attributes))
        joints = np.hstack([self.array(attributes[f"JOINTS_{k}"]) for k in sets])
        return joints, np.hstack([self.array(attributes[f"WEIGHTS_{k}"]) for k in sets])

    def posed(self, name: str, *, frame: int | None = None) -> np.ndarray:
        """(N, 3) of a part: morph targets, then skinning; at a keyframe of the first animation, or at rest."""
        nodes = [dict(node) for node in self.json["nodes"]]
        if frame is not None:
            self._animate(nodes, frame)
        index = next(k for k, node in enumerate(nodes) if "mesh" in node and node["name"] == name)
        mesh, primitive = self.mesh(name)
        positions = self.array(primitive["attributes"]["POSITION"]).astype(np.float64)
        weights = nodes[index].get("weights", mesh.get("weights", []))
        for weight, target in zip(weights, primitive.get("targets", []), strict=True):
            positions += weight * self.array(target["POSITION"])
        skin = self.json["skins"][nodes[index]["skin"]]
        inverse_binds = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2).astype(np.float64)
        transforms = self._world(nodes)[skin["joints"]] @ inverse_binds
        joints, influence = self.influences(name)
        blended = np.einsum("vk,vkab->vab", influence, transforms[joints])
        return np.einsum("vab,vb->va", blended[:, :3], np.pad(positions, ((0, 0), (0, 1)), constant_values=1.0))

    def _animate(self, nodes: list[dict], frame: int) -> None:
        (animation,) = self.json["animations"]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            frames = self.json["accessors"][sampler["input"]]["count"]
            values = self.array(sampler["output"]).reshape(frames, -1).astype(np.float64)
            nodes[channel["target"]["node"]][channel["target"]["path"]] = values[frame]

    @staticmethod
    def _world(nodes: list[dict]) -> np.ndarray:
        local = np.tile(np.eye(4), (len(nodes), 1, 1))
        for matrix, node in zip(local, nodes, strict=True):
            matrix[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
            matrix[:3, 3] = node.get("translation", (0, 0, 0))
        parent = {child: k for k, node in enumerate(nodes) for child in node.get("children", [])}
        world = local.copy()
        for k in range(len(nodes)):
            above = parent.get(k)
            while above is not None:
                world[k] = local[above] @ world[k]
                above = parent.get(above)
        return world

    def _view(self, index: int, dtype: str, count: int, offset: int) -> np.ndarray:
        view = self.json["bufferViews"][index]
        assert view["byteOffset"] % 4 == 0
        assert offset + count * np.dtype(dtype).itemsize <= view["byteLength"]
        return np.frombuffer(self.binary, dtype, count, view["byteOffset"] + offset)
