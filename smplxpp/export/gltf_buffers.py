"""Numpy arrays as accessors of one glTF binary buffer."""

from __future__ import annotations

import struct

import numpy as np
import pygltflib
from jaxtyping import Float32, Int, Shaped

_COMPONENT_TYPES = {
    np.dtype(np.uint8): pygltflib.UNSIGNED_BYTE,
    np.dtype(np.uint16): pygltflib.UNSIGNED_SHORT,
    np.dtype(np.uint32): pygltflib.UNSIGNED_INT,
    np.dtype(np.float32): pygltflib.FLOAT,
}
_ELEMENT_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
# The largest value of an index type is kept free: it restarts a strip in some graphics interfaces.
_UINT16_LIMIT = np.iinfo(np.uint16).max


class BufferBuilder:
    """Collects arrays into the one buffer of a `GLTF2`, each in a view of its own, aligned to 4 bytes."""

    def __init__(self, gltf: pygltflib.GLTF2) -> None:
        self._gltf = gltf
        self._chunks: list[bytes] = []
        self._size = 0

    def add(
        self,
        array: Shaped[np.ndarray, "N ..."],
        *,
        target: int | None = None,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """Store an array in the buffer and return its accessor.

        Args:
            array: (N, ...) uint8, uint16, uint32 or float32; matrices as (N, 4, 4) in rows, stored in columns.
            target: `pygltflib.ARRAY_BUFFER`, `ELEMENT_ARRAY_BUFFER`, or None for data that is not a vertex's.
            normalized: integers stand for fractions of their largest value.
            bounds: state the smallest and largest element.

        Returns:
            The index of the accessor.
        """
        stored = array.swapaxes(1, 2) if array.ndim == 3 else array
        accessor = self._accessor(array)
        accessor.bufferView = self._view(stored, target)
        accessor.normalized = normalized or None
        if bounds:
            accessor.min, accessor.max = _bounds(array)
        return self._append(accessor)

    def add_sparse(self, array: Float32[np.ndarray, "N 3"], rows: Int[np.ndarray, " n"]) -> int:
        """Store the given rows of a (N, 3) float32 array that is zero elsewhere; the bounds are always stated.

        Few moved rows are stored with their indices, many as a full array, whichever is smaller; of none at all one
        row of zeros, because assimp reads no accessor without any bytes.

        Args:
            array: (N, 3) float32.
            rows: (n,) increasing indices of the rows to keep.
        """
        kept = np.zeros_like(array)
        kept[rows] = array[rows]
        rows = rows if len(rows) else np.zeros(min(1, len(array)), np.int64)
        indices = rows.astype(index_dtype(len(array)))
        # Sparse storage pays only while indices and values together take less than the full array.
        if indices.nbytes + array[rows].nbytes >= array.nbytes:
            return self.add(kept, target=pygltflib.ARRAY_BUFFER, bounds=True)
        accessor = self._accessor(array)
        accessor.min, accessor.max = _bounds(kept)
        if len(rows):
            accessor.sparse = pygltflib.Sparse(
                count=len(rows),
                indices=pygltflib.AccessorSparseIndices(
                    bufferView=self._view(indices), componentType=_COMPONENT_TYPES[indices.dtype]
                ),
                values=pygltflib.AccessorSparseValues(bufferView=self._view(kept[rows])),
            )
        return self._append(accessor)

    def add_image(self, data: bytes, mime_type: str) -> int:
        """Store an encoded picture and return its texture, sampled without repeating."""
        gltf = self._gltf
        if not gltf.samplers:
            gltf.samplers.append(
                pygltflib.Sampler(
                    magFilter=pygltflib.LINEAR,
                    minFilter=pygltflib.LINEAR_MIPMAP_LINEAR,
                    wrapS=pygltflib.CLAMP_TO_EDGE,
                    wrapT=pygltflib.CLAMP_TO_EDGE,
                )
            )
        view = self._view(np.frombuffer(data, np.uint8))
        gltf.images.append(pygltflib.Image(bufferView=view, mimeType=mime_type))
        gltf.textures.append(pygltflib.Texture(sampler=0, source=len(gltf.images) - 1))
        return len(gltf.textures) - 1

    def glb(self) -> bytes:
        """The file: header, JSON chunk, binary chunk (glTF 2.0, section 4.4)."""
        binary = b"".join(self._chunks)
        self._gltf.buffers = [pygltflib.Buffer(byteLength=len(binary))]
        text = self._gltf.to_json(separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
        return b"".join(
            (header, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(binary), b"BIN\0"), binary)
        )

    def _view(self, array: np.ndarray, target: int | None = None) -> int:
        data = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        self._gltf.bufferViews.append(
            pygltflib.BufferView(buffer=0, byteOffset=self._size, byteLength=len(data), target=target)
        )
        data += bytes(-len(data) % 4)
        self._chunks.append(data)
        self._size += len(data)
        return len(self._gltf.bufferViews) - 1

    def _accessor(self, array: np.ndarray) -> pygltflib.Accessor:
        # Without a view an accessor has no offset either: pygltflib's default of 0 would be one.
        return pygltflib.Accessor(
            byteOffset=None,
            componentType=_COMPONENT_TYPES[array.dtype],
            count=len(array),
            type=_ELEMENT_TYPES[array.shape[1:]],
        )

    def _append(self, accessor: pygltflib.Accessor) -> int:
        self._gltf.accessors.append(accessor)
        return len(self._gltf.accessors) - 1


def index_dtype(count: int) -> type[np.unsignedinteger]:
    """The smaller of uint16 and uint32 that indexes `count` elements."""
    return np.uint16 if count <= _UINT16_LIMIT else np.uint32


def _bounds(array: np.ndarray) -> tuple[list, list]:
    return np.atleast_1d(array.min(axis=0)).tolist(), np.atleast_1d(array.max(axis=0)).tolist()
