"""Read PLY meshes, ASCII and binary of both byte orders: vertices, faces, colours, other properties."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.ply_elements import TYPES, Cells, Columns, Element, ListColumn, Property, read_element
from smplxpp.core.mesh_files.polygons import cut_polygons
from smplxpp.core.mesh_files.raw_mesh import (
    RawMesh,
    as_bytes,
    color_bytes,
    count_between,
    parse_numbers,
    require_indices,
    word_starts,
)
from smplxpp.core.mesh_files.texture import MISSING_GRAY, TextureCache, average_corner_colors, sample_texture

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Properties that a mesh keeps in fields of their own; all others are kept by name.
_KNOWN = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
_CORNERS = ("vertex_indices", "vertex_index")
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_TEXTURE_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def read_ply(path: Path) -> RawMesh:
    """Read the vertices and faces of a PLY mesh, with polygons cut into triangles.

    Face properties are repeated for each triangle of a polygon. Colours are those of the vertices. If there are none,
    or all are equal, they are sampled from the texture (`comment TextureFile`) at the coordinates of the vertices, or
    averaged over their corners.

    Raises:
        InputError: no PLY, a damaged header, less data than it announces, indices of missing vertices.
    """
    subject = f"mesh file {path}"
    data = read_bytes(path, subject="mesh file")
    byte_order, elements, pictures, body = _read_header(data, subject)
    if byte_order:
        cells = Cells(np.frombuffer(data, np.uint8)[body:], byte_order)
    else:
        cells = _ascii_cells(data[body:], sum(element.count for element in elements), subject)
    # All elements in their order, because each begins where the one before it ends.
    found: dict[str, Columns] = {}
    place = 0
    for element in elements:
        found[element.name], place = read_element(cells, place, element, subject=subject)
    vertex, face = found.get("vertex", {}), found.get("face", {})
    if "face" not in found and "tristrips" in found:
        raise InputError(
            subject,
            expected="faces",
            received="triangle strips",
            remedy="export triangles; MeshLab writes them when it saves the file again",
        )
    # Vertices, polygons and their triangles.
    vertices = _vertices(vertex, subject)
    corners = next((face[name] for name in _CORNERS if name in face), None)
    if corners is None:
        corners = ListColumn(np.empty(0, np.int64), np.empty(0, np.int64))
    if not isinstance(corners, ListColumn) or corners.values.dtype.kind not in "iu":
        raise InputError(f"{subject}: faces", expected="lists of whole numbers", received="another property")
    # Indices beyond the vertices would read foreign memory in later steps.
    require_indices(corners.values, len(vertices), subject=subject)
    cut = cut_polygons(corners.values, corners.lengths, vertices, subject=subject)
    # A texture replaces vertex colours that are all equal.
    colors = _vertex_colors(vertex, subject)
    if pictures and (colors is None or (colors == colors[:1]).all()):
        found_in_pictures = _picture_colors(path, vertex, face, corners, pictures, vertex_count=len(vertices))
        colors = colors if found_in_pictures is None else found_in_pictures
    return RawMesh(
        vertices,
        cut.faces,
        colors,
        _extra(vertex),
        # A polygon's properties apply to each of its triangles.
        {name: column[cut.polygons] for name, column in _extra(face).items()},
        source_faces=cut.source_faces,
        vertex_normals=None if len(cut.faces) else _normals(vertex),
    )


def _read_header(data: bytes, subject: str) -> tuple[str, list[Element], list[str], int]:
    """Return the byte order, the elements, the names of textures, and the place of the data."""
    if not data.startswith(b"ply"):
        raise InputError(subject, expected="a PLY file, which begins with `ply`", received=repr(data[:16]))
    # The header is looked for in the first MiB; line ends of all three systems occur.
    end = re.search(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\n|\r)", data[: 1 << 20])
    if end is None:
        raise InputError(subject, expected="a header that ends with `end_header`", received="none")
    body = end.end()
    # A header of lone carriage returns may be followed by a byte 10 of the data.
    if end.group(1) == b"\r\n" and b"\r\n" not in data[: end.start(1)]:
        body -= 1
    byte_order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    pictures: list[str] = []
    for line in re.split(r"[\r\n]+", data[: end.start(1)].decode("latin1"))[1:]:
        words = line.split()
        match words:
            case ["format", name, _] if name in _ORDERS:
                byte_order = _ORDERS[name]
            case ["comment", "TextureFile", *_]:
                pictures.append(line.split(None, 2)[2].strip() if len(words) > 2 else "")
            case [] | ["comment" | "obj_info" | "end_header", *_]:
                pass
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count, re.ASCII):
                elements.append((name, int(count), []))
            case ["property", "list", lengths, values, name] if elements and lengths in TYPES and values in TYPES:
                if TYPES[lengths][0] == "f":
                    raise InputError(f"{subject}: header", expected="whole lengths of lists", received=line[:80])
                elements[-1][2].append(Property(name, TYPES[values], TYPES[lengths]))
            case ["property", values, name] if elements and values in TYPES:
                elements[-1][2].append(Property(name, TYPES[values]))
            case _:
                raise InputError(f"{subject}: header", expected="lines of a PLY header", received=repr(line[:80]))
    if byte_order is None:
        raise InputError(f"{subject}: header", expected=f"a format of {', '.join(_ORDERS)}", received="none")
    if len({name for name, _, _ in elements}) < len(elements):
        raise InputError(f"{subject}: header", expected="each element once", received="two of one name")
    for name, _, properties in elements:
        if len({p.name for p in properties}) < len(properties):
            raise InputError(f"{subject}: header", expected="each property once", received=f"two alike of {name}")
    return byte_order, [Element(name, count, tuple(ps)) for name, count, ps in elements], pictures, body


def _ascii_cells(text: bytes, rows: int, subject: str) -> Cells:
    """Parse all numbers of an ASCII file, with the starts of its lines if there is a line for each row."""
    numbers = parse_numbers(text, subject=subject)
    text = text.replace(b"\r", b"\n")
    starts = np.concatenate([[0], np.flatnonzero(as_bytes(text) == 10) + 1])
    per_line = count_between(word_starts(text), starts)
    lines = np.concatenate([[0], np.cumsum(per_line[per_line > 0])])
    return Cells(numbers, "", lines if len(lines) == rows + 1 else None)


def _vertices(vertex: Columns, subject: str) -> Float64[np.ndarray, "N 3"]:
    axes = [vertex.get(axis) for axis in "xyz"]
    if not all(isinstance(column, np.ndarray) for column in axes):
        raise InputError(
            f"{subject}: vertices", expected="properties x, y and z", received=", ".join(vertex)[:200] or "none"
        )
    return np.stack([np.asarray(column, np.float64) for column in axes], axis=1)


def _normals(vertex: Columns) -> Float64[np.ndarray, "N 3"] | None:
    axes = [vertex.get(axis) for axis in ("nx", "ny", "nz")]
    if not all(isinstance(column, np.ndarray) for column in axes):
        return None
    return np.stack([np.asarray(column, np.float64) for column in axes], axis=1)


def _extra(columns: Columns) -> dict[str, np.ndarray]:
    return {name: c for name, c in columns.items() if isinstance(c, np.ndarray) and name not in _KNOWN}


def _vertex_colors(vertex: Columns, subject: str) -> UInt8[np.ndarray, "N 3"] | None:
    for names in _COLORS:
        columns = [vertex.get(name) for name in names]
        if all(isinstance(column, np.ndarray) for column in columns):
            return color_bytes(np.stack([np.asarray(column) for column in columns], axis=1), subject=subject)
    return None


def _picture_colors(
    path: Path, vertex: Columns, face: Columns, corners: ListColumn, names: list[str], *, vertex_count: int
) -> UInt8[np.ndarray, "N 3"] | None:
    """Sample textures at the coordinates of vertices or corners; None without coordinates or without any texture."""
    scalars = {name: column for name, column in vertex.items() if isinstance(column, np.ndarray)}
    pairs = [(scalars[a], scalars[b]) for a, b in _TEXTURE_COORDINATES if a in scalars and b in scalars]
    coordinates = np.stack(pairs[0], axis=1) if pairs else None
    # By default each vertex has one coordinate and all use the first texture.
    vertices, page = np.arange(vertex_count), np.zeros(vertex_count, np.int64)
    # Without coordinates of vertices there may be a list of two for each corner in the faces.
    if coordinates is None:
        lists = face.get("texcoord")
        if not isinstance(lists, ListColumn) or not np.array_equal(lists.lengths, 2 * corners.lengths):
            return None
        vertices, coordinates = corners.values.astype(np.int64), lists.values.reshape(-1, 2)
        page = np.zeros(len(vertices), np.int64)
        number = face.get("texnumber")
        if isinstance(number, np.ndarray):
            # A vertex between two textures takes that of its first corner.
            pages = np.repeat(number, corners.lengths)
            found_at, first = np.unique(vertices, return_index=True)
            page = np.where(pages == pages[first][np.searchsorted(found_at, vertices)], pages, -1)
    colors, found = np.full((vertex_count, 3), MISSING_GRAY, np.uint8), False
    pictures = TextureCache(f"mesh file {path}")
    for k in np.unique(page[(page >= 0) & (page < len(names))]):
        picture = pictures.load(path, names[int(k)])
        if picture is not None:
            at, mean = average_corner_colors(vertices[page == k], sample_texture(picture, coordinates[page == k]))
            colors[at] = mean
            found = True
    return colors if found else None
