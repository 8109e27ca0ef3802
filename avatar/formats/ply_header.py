"""Where the vertices of a binary PLY lie and what each holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smplxpp.core.errors import InputError

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_MOST_DIGITS = 18
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 20


@dataclass(frozen=True)
class PlyLayout:
    """Where the vertices of a file are.

    Attributes:
        start: their first byte.
        count: how many.
        dtype: structured, a field for each property.
    """

    start: int
    count: int
    dtype: np.dtype


def read_ply_layout(data: bytes, subject: str) -> PlyLayout:
    """Return the layout of element `vertex`, wherever it stands among elements without lists.

    Args:
        data: the file from its beginning.
        subject: names the file in errors.

    Raises:
        InputError: no PLY, a text PLY, a header that is cut, wrong or without vertices.
    """
    lines, start = _header_lines(data, subject)
    order = ""
    elements: list[tuple[str, int, list[tuple[str, str] | None]]] = []
    for line in lines[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _ORDERS and not order:
                order = _ORDERS[name]
            case ["format", "ascii", _]:
                raise InputError(
                    subject, expected="a binary PLY", received="a text PLY", remedy="save it as binary little endian"
                )
            case ["element", name, digits] if digits.isdecimal() and len(digits) <= _MOST_DIGITS:
                elements.append((name, int(digits), []))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append((name, _TYPES[kind]))
            case ["property", "list", _, _, _] if elements:
                elements[-1][2].append(None)
            case _:
                raise _bad_header(subject, f"the line {line[:80]!r}")
    if not order:
        raise _bad_header(subject, "no format")
    for name, count, properties in elements:
        fields = [p for p in properties if p is not None]
        names = [field for field, _ in fields]
        if len(fields) < len(properties):
            raise _bad_header(subject, f"lists in element {name!r}, at or before the vertices")
        if len(set(names)) < len(names):
            raise _bad_header(subject, f"a property twice in element {name!r}")
        dtype = np.dtype([(n, order + kind) for n, kind in fields])
        if name == "vertex":
            return PlyLayout(start, count, dtype)
        start += count * dtype.itemsize
    raise _bad_header(subject, "no element 'vertex'")


def _header_lines(data: bytes, subject: str) -> tuple[list[str], int]:
    """Return the lines before `end_header`, and where the numbers start."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise InputError(subject, expected="a PLY file", received=f"a file that starts with {data[:4]!r}")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise _bad_header(subject, "no end of it")
    try:
        return data[:end].decode("ascii").splitlines(), newline + 1
    except UnicodeDecodeError:
        raise _bad_header(subject, "letters outside ASCII") from None


def _bad_header(subject: str, received: str) -> InputError:
    return InputError(f"{subject}: header", expected="a PLY header of version 1.0", received=received)
