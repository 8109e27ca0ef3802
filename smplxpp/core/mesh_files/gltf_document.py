"""Read the container and the accessors of glTF 2.0, checking each offset, stride and count against the file.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 (binary data) and 4.4 (GLB).
"""

from __future__ import annotations

import binascii
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files import as_integer, as_list, as_object, as_text, parse_json, read_bytes
from smplxpp.core.mesh_files.gltf_compression import MESHOPT, draco_primitive, meshopt_view
from smplxpp.core.mesh_files.texture import TextureCache, file_beside

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_DAMAGED = "the file is damaged or incomplete: copy or export it again"


class GltfDocument:
    """A `.gltf` or `.glb` file with its JSON document and buffers.

    Attributes:
        path: path of the file.
        subject: name of the file in messages.
        size: size of the file in bytes.
        json: JSON document.
        pictures: cache of decoded images, by the index of the image.

    Raises:
        InputError: no glTF 2.0, or a container whose lengths do not fit.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.subject = path, f"mesh file {path}"
        data = read_bytes(path, subject="mesh file")
        self.size = len(data)
        self._binary: bytes | None = None
        # GLB (glTF 2.0, section 4.4): magic, version, total length, then chunks.
        if data[:4] == b"glTF":
            data, self._binary = self._chunks(data)
        elif b"{" not in data[:64]:
            expected = "glTF: JSON, or binary, which begins with `glTF`"
            raise InputError(self.subject, expected=expected, received=repr(data[:8])[1:], remedy=_DAMAGED)
        self.json = as_object(parse_json(data, subject=self.subject), subject=self.subject)
        version = as_text(self.part(self.json, "asset").get("version", ""), subject=f"{self.subject}: asset.version")
        if not version.startswith("2."):
            raise InputError(self.subject, expected="glTF 2.0", received=f"version {version or 'unknown'}")
        self._buffers: dict[int, bytes] = {}
        self._files: dict[Path, bytes] = {}
        self._decoded: dict[int, np.ndarray] = {}  # values of accessors that Draco held, by their index
        self._views: dict[int, tuple[memoryview, int]] = {}
        self._unpacked: set[int] = set()  # views of Draco's primitives that are among the accessors
        self.pictures = TextureCache(self.subject)

    def _chunks(self, data: bytes) -> tuple[bytes, bytes | None]:
        """Return the JSON chunk and the binary chunk (None without one) of a GLB."""
        json_chunk, binary_chunk = 0x4E4F534A, 0x004E4942  # "JSON" and "BIN\0" as little-endian integers
        found: dict[int, bytes] = {}
        # The header of 12 bytes; the stated length bounds the walk, even if more data follow.
        place, end = 12, min(int.from_bytes(data[8:12], "little"), len(data))
        if int.from_bytes(data[4:8], "little") != 2 or int.from_bytes(data[8:12], "little") > len(data):
            raise InputError(self.subject, expected="a whole GLB 2 file", received="another", remedy=_DAMAGED)
        # A chunk: length, type, data.
        while place + 8 <= end:
            length, kind = (int.from_bytes(data[place + k : place + k + 4], "little") for k in (0, 4))
            if place + 8 + length > end:
                raise InputError(
                    self.subject, expected="chunks within the file", received="a longer one", remedy=_DAMAGED
                )
            found.setdefault(kind, data[place + 8 : place + 8 + length])
            place += 8 + length
        if json_chunk not in found:
            raise InputError(self.subject, expected="a JSON chunk", received="none", remedy=_DAMAGED)
        return found[json_chunk], found.get(binary_chunk)

    def part(self, of: dict[str, Any], name: str) -> dict[str, Any]:
        """Return a member that must be an object; {} where it is missing."""
        return as_object(of.get(name, {}), subject=f"{self.subject}: {name}")

    def items(self, of: dict[str, Any], name: str) -> list[Any]:
        """Return a member that must be a list; [] where it is missing."""
        return as_list(of.get(name, []), subject=f"{self.subject}: {name}")

    def entry(self, kind: str, index: Any) -> dict[str, Any]:
        """Return the object at an index of one of the document's lists.

        Raises:
            InputError: no such entry.
        """
        entries = self.items(self.json, kind)
        if not entries:
            raise InputError(f"{self.subject}: {kind}", expected="entries", received="none", remedy=_DAMAGED)
        place = as_integer(index, subject=f"{self.subject}: index of {kind}", least=0, most=len(entries) - 1)
        return as_object(entries[place], subject=f"{self.subject}: {kind}[{place}]")

    def number(self, of: dict[str, Any], name: str, default: int | None = None) -> int:
        """Return a member that must be a count, an offset or an index."""
        return as_integer(of.get(name, default), subject=f"{self.subject}: {name}", least=0, most=2**53)

    def view(self, index: Any) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride (0 for none).

        Raises:
            InputError: a view outside its buffer, or compressed data that are damaged.
            MissingExtraError: a compressed one, without its codec.
        """
        view = self.entry("bufferViews", index)
        for name, value in self.part(view, "extensions").items():
            if name in MESHOPT:
                if index not in self._views:
                    compressed = as_object(value, subject=f"{self.subject}: {name}")
                    buffer = self._buffer(self.number(compressed, "buffer"))
                    self._views[index] = meshopt_view(self.subject, compressed, buffer)
                return self._views[index]
        data = self._buffer(self.number(view, "buffer"))
        start, length = self.number(view, "byteOffset", 0), self.number(view, "byteLength")
        if start + length > len(data):
            raise InputError(
                f"{self.subject}: buffer view",
                expected=f"at most {len(data)} bytes",
                received=f"{length} from {start} on",
                remedy=_DAMAGED,
            )
        return memoryview(data)[start : start + length], self.number(view, "byteStride", 0)

    def accessor(self, index: Any) -> np.ndarray:
        """Return the values of an accessor, (count, components), as stored or normalized to [-1, 1] or [0, 1].

        Raises:
            InputError: values outside their buffer view, or an unknown type.
        """
        accessor = self.entry("accessors", index)
        count = self.number(accessor, "count")
        kind = _COMPONENTS.get(self.number(accessor, "componentType"))
        width = _TYPES.get(as_text(accessor.get("type"), subject=f"{self.subject}: accessor type"))
        if kind is None or width is None:
            raise InputError(
                f"{self.subject}: accessor",
                expected="numbers, vectors or 4 x 4 matrices",
                received=f"component type {accessor.get('componentType')}, type {accessor.get('type')}"[:80],
            )
        if "bufferView" in accessor:
            values = self._values(accessor, count, width, kind)
        elif index in self._decoded:
            values = self._decoded[index]
            # The count is the codec's, which leaves faces without an area out.
            if values.shape[1] != width:
                received = f"{values.shape[1]} in the compressed data"
                raise InputError(f"{self.subject}: accessor", expected=f"{width} components", received=received)
        elif "sparse" in accessor and count <= 1 << 20:  # zeros without bytes, which no small file may blow up
            values = np.zeros((count, width), kind)
        else:
            raise InputError(f"{self.subject}: accessor", expected="data", received="none", remedy=_DAMAGED)
        if "sparse" in accessor:
            values = self._with_sparse(values, self.part(accessor, "sparse"), kind)
        values = values.astype(np.dtype(kind).newbyteorder("="))
        # Signed integers map to max(c / max, -1), unsigned ones to c / max.
        if accessor.get("normalized") is True and values.dtype.kind in "iu":
            return np.maximum(values / float(np.iinfo(values.dtype).max), -1.0)
        return values

    def decompress(self, attributes: dict[str, Any], indices: Any, draco: dict[str, Any]) -> None:
        """Decode a primitive that Draco holds, so that `accessor` returns its values.

        Args:
            attributes: accessor of each attribute of the primitive.
            indices: accessor of its indices; None: it has none.
            draco: the primitive's JSON object of the extension.

        Raises:
            InputError: damaged data.
            MissingExtraError: the codec is not installed.
        """
        view = self.number(draco, "bufferView")
        if view in self._unpacked:
            return
        self._unpacked.add(view)
        found, faces = draco_primitive(self.subject, draco, self.view(view)[0])
        for name, values in found.items():
            if name in attributes:
                accessor = self.entry("accessors", attributes[name])
                kind = _COMPONENTS.get(self.number(accessor, "componentType"), values.dtype)
                self._decoded[attributes[name]] = values.astype(kind)
        if indices is not None and self.entry("accessors", indices):
            self._decoded[indices] = faces.astype("<u4")[:, None]

    def _values(self, of: dict[str, Any], count: int, width: int, kind: str) -> np.ndarray:
        """Return a view of values in a buffer view, without a copy."""
        data, stride = self.view(of["bufferView"])
        start, item = self.number(of, "byteOffset", 0), width * np.dtype(kind).itemsize
        # A stride of zero means tightly packed values.
        stride = stride or item
        if count and (start + (count - 1) * stride + item > len(data) or stride < item):
            raise InputError(
                f"{self.subject}: accessor",
                expected=f"values within the {len(data)} bytes of its view",
                received=f"{count} of {item} bytes, {stride} apart, from {start} on",
                remedy=_DAMAGED,
            )
        # numpy refuses a zero-length view at the end of a buffer.
        if not count:
            return np.empty((0, width), kind)
        return np.ndarray((count, width), kind, buffer=data, offset=start, strides=(stride, item // width))

    def _with_sparse(self, values: np.ndarray, sparse: dict[str, Any], kind: str) -> np.ndarray:
        """Return a copy of the values with the entries of a sparse accessor replaced."""
        count = self.number(sparse, "count")
        where, what = self.part(sparse, "indices"), self.part(sparse, "values")
        places_kind = _COMPONENTS.get(self.number(where, "componentType"), "")
        if places_kind not in ("u1", "<u2", "<u4") or "bufferView" not in where or "bufferView" not in what:
            raise InputError(
                f"{self.subject}: sparse accessor", expected="unsigned indices, and values", received="others"
            )
        places = self._values(where, count, 1, places_kind).reshape(-1)
        if count and places.max() >= len(values):
            raise InputError(f"{self.subject}: sparse accessor", expected="indices below its count", received="others")
        values = values.copy()
        # Later entries overwrite earlier ones at the same place.
        values[places] = self._values(what, count, values.shape[1], kind)
        return values

    def _buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer: the binary chunk, a data URI, or a file beside the document."""
        if index not in self._buffers:
            buffer = self.entry("buffers", index)
            if "uri" in buffer:
                uri = as_text(buffer["uri"], subject=f"{self.subject}: buffer uri")
                found = self.resource(uri)
                if found is None:
                    raise InputError(
                        f"{self.subject}: buffer",
                        expected="a file in the mesh file's folder",
                        received=repr(uri[:80]),
                        remedy="copy the file that belongs to it beside it",
                    )
                data = found
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise InputError(f"{self.subject}: buffer", expected="data", received="none", remedy=_DAMAGED)
            self._buffers[index] = data
        return self._buffers[index]

    @property
    def held_bytes(self) -> int:
        """Total size in bytes of what was read or decompressed so far, the document's own file included."""
        files = sum(len(data) for data in self._files.values())
        unpacked = sum(len(view) for view, _ in self._views.values()) + sum(v.nbytes for v in self._decoded.values())
        return self.size + files + unpacked

    def resource(self, uri: str) -> bytes | None:
        """Return the bytes of a data URI or of a file inside the document's folder; None without such a file.

        Raises:
            InputError: a data URI that is not base64.
        """
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                return binascii.a2b_base64(text) if head.endswith(";base64") else urllib.parse.unquote_to_bytes(text)
            except (binascii.Error, ValueError) as error:
                raise InputError(f"{self.subject}: data URI", expected="base64", received=str(error)) from None
        found = file_beside(self.path, urllib.parse.unquote(uri))
        if found is None:
            return None
        if found not in self._files:
            self._files[found] = read_bytes(found, subject=f"{self.subject}: file")
        return self._files[found]
