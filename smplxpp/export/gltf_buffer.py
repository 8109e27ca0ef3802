"""The binary buffer of a glTF file: aligned views, and accessors with their bounds."""

from __future__ import annotations

import numpy as np
import pygltflib as gl

_COMPONENT = {
    np.dtype(np.uint8): gl.UNSIGNED_BYTE,
    np.dtype(np.uint16): gl.UNSIGNED_SHORT,
    np.dtype(np.uint32): gl.UNSIGNED_INT,
    np.dtype(np.float32): gl.FLOAT,
}
_TYPE = {(): gl.SCALAR, (3,): gl.VEC3, (4,): gl.VEC4, (4, 4): gl.MAT4}
# The largest index of 16 bits is the restart value.
_MAX_SHORT_COUNT = 65535


class GltfBuffer:
    """Collects arrays into one buffer and writes the views and accessors of `document` that describe them."""

    def __init__(self, document: gl.GLTF2) -> None:
        self._document, self._data = document, bytearray()

    def add(
        self, array: np.ndarray, *, target: int | None = None, normalized: bool = False, bounds: bool = False
    ) -> int:
        """An accessor of (N,), (N, 3), (N, 4) or (N, 4, 4) values (matrices row-major); returns its index."""
        array = np.ascontiguousarray(array.swapaxes(1, 2) if array.ndim == 3 else array)
        accessor = self._accessor(array, bounds=bounds)
        accessor.bufferView, accessor.normalized = self._view(array, target), normalized
        return self._append(accessor)

    def add_indices(self, faces: np.ndarray, vertex_count: int) -> int:
        """An accessor of the corners of (M, 3) faces, in 16 bits where they suffice."""
        dtype = np.uint16 if vertex_count <= _MAX_SHORT_COUNT else np.uint32
        return self.add(faces.astype(dtype).ravel(), target=gl.ELEMENT_ARRAY_BUFFER)

    def add_sparse(self, array: np.ndarray) -> int:
        """An accessor of (N, 3) float32 values that keeps only the rows other than zero."""
        rows = np.flatnonzero((array != 0).any(axis=1))
        accessor = self._accessor(array, bounds=True)
        if len(rows):
            indices = rows.astype(np.uint16 if len(array) <= _MAX_SHORT_COUNT else np.uint32)
            accessor.sparse = gl.Sparse(
                count=len(rows),
                indices=gl.AccessorSparseIndices(
                    bufferView=self._view(indices, None), componentType=_COMPONENT[indices.dtype]
                ),
                values=gl.AccessorSparseValues(bufferView=self._view(np.ascontiguousarray(array[rows]), None)),
            )
        return self._append(accessor)

    def finish(self) -> None:
        """Hand the buffer to the document."""
        self._document.buffers = [gl.Buffer(byteLength=len(self._data))]
        self._document.set_binary_blob(bytes(self._data))

    def _accessor(self, array: np.ndarray, *, bounds: bool) -> gl.Accessor:
        accessor = gl.Accessor(
            componentType=_COMPONENT[array.dtype], count=len(array), type=_TYPE[array.shape[1:]], byteOffset=None
        )
        if bounds:
            columns = array.reshape(len(array), -1)
            accessor.min, accessor.max = columns.min(axis=0).tolist(), columns.max(axis=0).tolist()
        return accessor

    def _append(self, accessor: gl.Accessor) -> int:
        self._document.accessors.append(accessor)
        return len(self._document.accessors) - 1

    def _view(self, array: np.ndarray, target: int | None) -> int:
        # Every view starts at a multiple of four, the largest component.
        self._data += b"\0" * (-len(self._data) % 4)
        view = gl.BufferView(buffer=0, byteOffset=len(self._data), byteLength=array.nbytes, target=target)
        self._data += array.tobytes()
        self._document.bufferViews.append(view)
        return len(self._document.bufferViews) - 1
