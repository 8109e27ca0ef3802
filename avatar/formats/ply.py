"""Read and write splats as PLY files in the layout of 3D Gaussian Splatting."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.formats.splats import REST_COUNTS, Splats
from smplxpp.core.errors import InputError
from smplxpp.core.files import atomic_path, read_bytes

_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
_DC = tuple(f"f_dc_{k}" for k in range(3))
_SCALE = tuple(f"scale_{k}" for k in range(3))
_ROTATION = tuple(f"rot_{k}" for k in range(4))
_OPACITY = ("opacity",)
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
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def write_splat_ply(path: str | Path, splats: Splats) -> None:
    """Write splats as a binary little-endian PLY; a failed write leaves no file.

    Properties, all float, in 3DGS's order: `x y z nx ny nz f_dc_0..2 f_rest_0..3K-1 opacity scale_0..2 rot_0..3`.
    `f_rest` is channel-major: all red coefficients, then green, then blue.
    """
    # 3DGS stores harmonics channel by channel: transpose (N, K, 3) to (N, 3, K).
    K = splats.f_rest.shape[1]
    names = (*_POSITION, *_NORMAL, *_DC, *_rest_names(3 * K), *_OPACITY, *_SCALE, *_ROTATION)
    columns = (
        splats.means,
        splats.normals,
        splats.f_dc,
        splats.f_rest.transpose(0, 2, 1).reshape(len(splats), 3 * K),
        splats.opacity_logits[:, None],
        splats.log_scales,
        splats.quats,
    )
    # The header is text; the table follows as one row of little-endian floats for each splat.
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    table = np.concatenate(columns, axis=1, dtype="<f4")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(table.data)


def read_splat_ply(path: str | Path) -> Splats:
    """Read a binary PLY of splats; properties may have any order and number type, unknown ones are ignored.

    Normals may be missing (they are 0 then). Values of another type than float are converted to it.

    Raises:
        InputError: a missing, damaged, truncated or text file, missing properties, values that are not finite.
    """
    path = Path(path)
    subject = f"splats {path}"
    data = read_bytes(path, subject="splats")
    # The header tells which properties there are; the number of `f_rest` gives the degree of the harmonics.
    layout = read_ply_layout(data, subject)
    names = layout.dtype.names or ()
    rest = [name for name in names if name.startswith("f_rest_")]
    required = (*_POSITION, *_DC, *_rest_names(len(rest)), *_OPACITY, *_SCALE, *_ROTATION)
    missing = [name for name in required if name not in names]
    if missing or len(rest) not in REST_COUNTS:
        raise InputError(
            subject,
            expected=f"the properties of 3D Gaussian Splatting, {REST_COUNTS} of them f_rest",
            received=f"no {', '.join(missing)}" if missing else f"{len(rest)} of f_rest",
            remedy="export it as a splat PLY, not as a point cloud",
        )
    # Copy the properties by name, because files order them differently.
    table = _vertex_table(data, layout, subject)

    def columns(wanted: tuple[str, ...]) -> np.ndarray:
        out = np.empty((len(table), len(wanted)), np.float32)
        with np.errstate(over="ignore"):  # values outside of float32 become infinite and are refused below
            for k, name in enumerate(wanted):
                out[:, k] = table[name]
        return out

    # Files store harmonics as (3, K) a splat; `Splats` has (K, 3).
    K = len(rest) // 3
    try:
        return Splats(
            means=columns(_POSITION),
            normals=columns(_NORMAL) if set(_NORMAL) <= set(names) else np.zeros((len(table), 3), np.float32),
            f_dc=columns(_DC),
            f_rest=columns(_rest_names(len(rest))).reshape(len(table), 3, K).transpose(0, 2, 1),
            opacity_logits=columns(_OPACITY)[:, 0],
            log_scales=columns(_SCALE),
            quats=columns(_ROTATION),
        )
    except InputError as error:
        raise InputError(f"{subject}: {error.subject}", expected=error.expected, received=error.received) from None


def _vertex_table(data: bytes, layout: PlyLayout, subject: str) -> np.ndarray:
    # `frombuffer` maps the bytes without a copy, and would fail with an obscure error on a truncated file.
    size = layout.count * layout.dtype.itemsize
    if len(data) < layout.start + size:
        raise InputError(
            subject,
            expected=f"{size} bytes of {layout.count} splats",
            received=f"{max(0, len(data) - layout.start)}",
            remedy="the file is truncated: copy it again",
        )
    return np.frombuffer(data, layout.dtype, layout.count, layout.start)


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{k}" for k in range(count))


@dataclass(frozen=True)
class PlyLayout:
    """Position and layout of the vertices in a file.

    Attributes:
        start: offset of their first byte.
        count: number of vertices.
        dtype: structured, a field for each property.
    """

    start: int
    count: int
    dtype: np.dtype


def read_ply_layout(data: bytes, subject: str) -> PlyLayout:
    """Return the layout of the element `vertex`, which may follow other elements without lists.

    Args:
        data: the file from its beginning.
        subject: names the file in errors.

    Raises:
        InputError: no PLY, a text PLY, a truncated or wrong header, or one without vertices.
    """
    # `start` moves to the first byte of the vertices while their predecessors are skipped.
    lines, start = _header_lines(data, subject)
    order = ""
    elements: list[tuple[str, int, list[tuple[str, str] | None]]] = []
    # Parse the header into elements and their properties; None marks a list.
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
            case ["element", name, digits] if digits.isdecimal() and len(digits) <= 18:
                elements.append((name, int(digits), []))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append((name, _TYPES[kind]))
            case ["property", "list", _, _, _] if elements:
                elements[-1][2].append(None)
            case _:
                raise _bad_header(subject, f"the line {line[:80]!r}")
    if not order:
        raise _bad_header(subject, "no format")
    # Skip the elements before the vertices; lists have no fixed size, so nothing after them can be found.
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
    """Return the lines before `end_header`, and the offset of the data after it."""
    if data[:3] != b"ply" or data[3:4] not in (b"\n", b"\r"):
        raise InputError(subject, expected="a PLY file", received=f"a file that starts with {data[:4]!r}")
    # The header is searched in the first MiB alone, so that a huge foreign file is refused at once.
    end = data.find(b"end_header", 0, 1 << 20)
    newline = data.find(b"\n", end)
    if end < 0 or newline < 0:
        raise _bad_header(subject, "no end of it")
    try:
        return data[:end].decode("ascii").splitlines(), newline + 1
    except UnicodeDecodeError:
        raise _bad_header(subject, "letters outside ASCII") from None


def _bad_header(subject: str, received: str) -> InputError:
    return InputError(f"{subject}: header", expected="a PLY header of version 1.0", received=received)
