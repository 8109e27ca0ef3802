"""Pack tensors into the bytes of a safetensors file and unpack them, with numpy only.

The layout is the length of a JSON object, the object (name: dtype, shape, first and last byte), then the numbers.
`safetensors` reads these files, and a browser maps each tensor to a typed array.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_list, as_object, as_text, parse_json, shown

_METADATA = "__metadata__"
_DTYPES = {
    **{"F64": "<f8", "F32": "<f4", "F16": "<f2"},
    **{"I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "<i1"},
    **{"U64": "<u8", "U32": "<u4", "U16": "<u2", "U8": "<u1", "BOOL": "<?"},
}
_NAMES = {np.dtype(text): name for name, text in _DTYPES.items()}


def pack_tensors(tensors: Mapping[str, np.ndarray], about: Mapping[str, Any] | None = None) -> bytes:
    """Return tensors as the bytes of a safetensors file; equal tensors give equal bytes.

    Wider types come first, so that every tensor is aligned to its type and can be viewed in place.

    Args:
        tensors: arrays of numbers and bools by name.
        about: JSON object for the metadata; None: no metadata.

    Raises:
        ValueError: an array of another type.
    """
    # safetensors: eight bytes of the header's length, a JSON header, then the tensors without gaps.
    header: dict[str, Any] = {} if about is None else {_METADATA: {"about": json.dumps(about, sort_keys=True)}}
    blocks, start = [], 0
    for name, value in sorted(tensors.items(), key=lambda item: (-item[1].dtype.itemsize, item[0])):
        # The format is little-endian.
        array = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        if array.dtype not in _NAMES:
            raise ValueError(f"tensor {name} of type {value.dtype}")
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(value.shape),
            "data_offsets": [start, start + array.nbytes],
        }
        blocks.append(array.tobytes())
        start += array.nbytes
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # the numbers begin at a multiple of eight bytes
    return b"".join([len(text).to_bytes(8, "little"), text, *blocks])


def unpack_tensors(data: bytes, *, subject: str, remedy: str = "") -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the tensors that `pack_tensors` packed, as views of `data`, and the metadata object.

    Raises:
        InputError: anything but tensors that fill the data without gaps, each of its type and shape.
    """
    # The format itself allows headers of 100 MB; ours are thousands of bytes.
    longest_header = 1 << 20
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(longest_header, len(data) - 8):
        raise InputError(
            subject, expected="tensors behind a header", received=f"{len(data)} bytes of something else", remedy=remedy
        )
    header = as_object(parse_json(data[8 : 8 + length], subject=subject, remedy=remedy, strict=True), subject=subject)
    metadata = as_object(header.pop(_METADATA, {}), subject=f"{subject}: metadata")
    body, out, spans = memoryview(data)[8 + length :], {}, []
    for name, entry in header.items():
        out[name], span = _tensor(body, as_object(entry, subject=f"{subject}: {name}"), f"{subject}: {name}", remedy)
        spans.append(span)
    end = 0
    for first, last in sorted(spans):
        if first != end:  # gaps could hide data, and overlapping tensors expand a small file
            raise InputError(
                subject, expected="tensors one behind the other", received="holes, or shared bytes", remedy=remedy
            )
        end = last
    if end != len(body):
        raise InputError(subject, expected=f"{end} bytes of tensors", received=str(len(body)), remedy=remedy)
    if "about" not in metadata:
        return out, {}
    text = as_text(metadata["about"], subject=f"{subject}: metadata")
    return out, as_object(parse_json(text, subject=f"{subject}: metadata", strict=True), subject=f"{subject}: metadata")


def _tensor(
    body: memoryview, entry: Mapping[str, Any], subject: str, remedy: str
) -> tuple[np.ndarray, tuple[int, int]]:
    name = entry.get("dtype")
    if not isinstance(name, str) or name not in _DTYPES:
        raise InputError(subject, expected=f"a type among {', '.join(_DTYPES)}", received=shown(name), remedy=remedy)
    dtype = np.dtype(_DTYPES[name])
    most = len(body)
    shape = [as_integer(n, subject=subject, least=0, most=most) for n in as_list(entry.get("shape"), subject=subject)]
    span = [as_integer(n, subject=subject, least=0) for n in as_list(entry.get("data_offsets"), subject=subject)]
    if len(shape) > 8 or len(span) != 2:
        raise InputError(subject, expected="a shape and two offsets", received=shown(entry), remedy=remedy)
    first, last = span
    # The span must lie inside the body and have exactly the bytes of type and shape.
    if not first <= last <= most or last - first != math.prod(shape) * dtype.itemsize:
        raise InputError(
            subject,
            expected=f"{math.prod(shape) * dtype.itemsize} bytes of {most}",
            received=f"those from {first} to {last}",
            remedy=remedy,
        )
    array = np.frombuffer(body[first:last], dtype=np.uint8)
    # A byte other than 0 and 1 in a bool array is undefined behaviour in numpy.
    if name == "BOOL" and array.size and array.max() > 1:
        raise InputError(subject, expected="bools", received="other bytes", remedy=remedy)
    return array.view(dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False), (first, last)
