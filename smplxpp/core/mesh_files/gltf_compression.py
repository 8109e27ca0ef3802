"""Decompress the geometry of glTF files: Draco's primitives, and buffer views of meshoptimizer's codec.

KHR_draco_mesh_compression, EXT_meshopt_compression and KHR_meshopt_compression of
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0. The codecs are those of their authors, through the
bindings DracoPy and meshoptimizer, which the extra `gltf` installs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int64

from smplxpp.core.errors import InputError
from smplxpp.core.files import as_integer, as_object, as_text
from smplxpp.core.lazy import import_extra

MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""Names of the extension of buffer views."""
DRACO = "KHR_draco_mesh_compression"
"""Name of the extension of primitives."""

_DAMAGED = "the file is damaged or incomplete: copy or export it again"
# Formats and what their elements may be, in bytes: indices of two or four, attributes in whole words up to 256.
_STRIDES = {"TRIANGLES": (2, 4), "INDICES": (2, 4), "ATTRIBUTES": tuple(range(4, 257, 4))}
_FILTERS = {"OCTAHEDRAL": "decode_filter_oct", "QUATERNION": "decode_filter_quat", "EXPONENTIAL": "decode_filter_exp"}


def meshopt_view(subject: str, extension: Mapping[str, Any], data: bytes | memoryview) -> tuple[memoryview, int]:
    """Return the bytes of a buffer view that meshoptimizer's codec holds, and their stride.

    Args:
        subject: name of the file in messages.
        extension: the buffer view's JSON object of that extension.
        data: the buffer that it names.

    Raises:
        MissingExtraError: the codec is not installed.
        InputError: an unknown format, more than 1 GiB, or data that the codec refuses.
    """
    subject = f"{subject}: meshopt view"
    number = {
        name: as_integer(extension.get(name, 0), subject=f"{subject}: {name}", least=0, most=1 << 40)
        for name in ("byteOffset", "byteLength", "byteStride", "count")
    }
    mode = as_text(extension.get("mode", ""), subject=f"{subject}: mode")
    filtered = as_text(extension.get("filter", "NONE"), subject=f"{subject}: filter")
    start, stride, count = number["byteOffset"], number["byteStride"], number["count"]
    end, most = start + number["byteLength"], 1 << 30
    if stride not in _STRIDES.get(mode, ()) or filtered not in ("NONE", *_FILTERS):
        raise InputError(
            subject,
            expected=f"{', '.join(_STRIDES)} of a known stride, {', '.join(_FILTERS)} or no filter",
            received=f"{mode or 'no mode'} of {stride} bytes, filter {filtered}"[:120],
            remedy=_DAMAGED,
        )
    if end > len(data) or count * stride > most:
        received = f"{count} of {stride} bytes, compressed in bytes {start} to {end}"
        expected = f"bytes below {len(data)}, 1 GiB at most"
        raise InputError(subject, expected=expected, received=received, remedy=_DAMAGED)
    codec = import_extra("meshoptimizer", extra="gltf", purpose="reading meshopt-compressed glTF files")
    packed = bytes(data[start:end])
    if not count:
        return memoryview(b""), stride
    try:
        if mode == "ATTRIBUTES":
            words = codec.decode_vertex_buffer(count, stride, packed, dtype=np.dtype((np.uint8, stride)))
        else:
            decode = codec.decode_index_buffer if mode == "TRIANGLES" else codec.decode_index_sequence
            words = decode(count, 4, packed).astype(f"<u{stride}")
    except (RuntimeError, ValueError) as error:
        raise InputError(subject, expected="data of the codec", received=str(error)[:120], remedy=_DAMAGED) from None
    if filtered != "NONE":
        words = getattr(codec, _FILTERS[filtered])(words, count, stride)
    return memoryview(words.tobytes()), stride


def draco_primitive(
    subject: str, extension: Mapping[str, Any], data: bytes | memoryview
) -> tuple[dict[str, np.ndarray], Int64[np.ndarray, " k"]]:
    """Return the attributes of a primitive by glTF's names, (n, components) as stored, and its indices.

    Args:
        subject: name of the file in messages.
        extension: the primitive's JSON object of that extension.
        data: bytes of the buffer view that it names.

    Raises:
        MissingExtraError: the codec is not installed.
        InputError: data that the codec refuses, or without an attribute that the file says is there.
    """
    subject = f"{subject}: Draco primitive"
    codec = import_extra("DracoPy", extra="gltf", purpose="reading Draco-compressed glTF files")
    try:
        mesh = codec.decode(bytes(data))
    # DracoPy raises an exception of its own for foreign data, ValueError and RuntimeError for damage.
    except (codec.FileTypeException, ValueError, RuntimeError, TypeError) as error:
        received = str(error)[:120] or type(error).__name__
        raise InputError(subject, expected="data of the codec", received=received, remedy=_DAMAGED) from None
    found = {row["unique_id"]: np.asarray(row["data"]) for row in mesh.attributes}
    out = {}
    for name, number in as_object(extension.get("attributes", {}), subject=f"{subject}: attributes").items():
        values = found.get(as_integer(number, subject=f"{subject}: {name}", least=0, most=1 << 32))
        if values is None:
            raise InputError(subject, expected=f"attribute {name}", received="no such data", remedy=_DAMAGED)
        out[name] = values.reshape(len(values), -1)
    faces = getattr(mesh, "faces", None)
    if faces is None:
        raise InputError(subject, expected="a mesh", received="points alone", remedy="export triangles")
    return out, np.asarray(faces, dtype=np.int64).reshape(-1)
