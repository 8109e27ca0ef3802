"""Read Wavefront OBJ files: vertices, faces, colours; https://paulbourke.net/dataformats/obj/.

Vertices are the file's `v` lines, all of them and in their order, regardless of objects, groups, materials, texture
coordinates and normals; faces are its `f` lines.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.mesh_files.obj_material import Material, read_materials
from smplxpp.core.mesh_files.polygons import cut_polygons
from smplxpp.core.mesh_files.raw_mesh import (
    IS_SPACE,
    FacePictures,
    RawMesh,
    as_bytes,
    color_bytes,
    count_between,
    decode_name,
    parse_numbers,
    require_indices,
    warn,
    word_starts,
)
from smplxpp.core.mesh_files.texture import (
    CLAMP,
    MISSING_GRAY,
    REPEAT,
    TextureCache,
    average_corner_colors,
    bounded_places,
    file_beside,
    picture_bytes,
    sample_texture,
)

# Bytes of lines that are parsed at once, which bounds the work space.
_BLOCK = 1 << 24


def read_obj(path: Path) -> RawMesh:
    """Read the vertices, faces and colours of an OBJ file.

    Colours are those of the `v` lines (`v x y z r g b`), else those of the material: its texture averaged over the
    texture coordinates of the vertex, or its `Kd`.

    Raises:
        InputError: a word that is not a number, a vertex of fewer than three numbers, indices of missing vertices.
    """
    subject = f"mesh file {path}"
    lines = _Lines.of(read_bytes(path, subject="mesh file"))
    # Faces first as references of the file, since negative ones depend on how many vertices precede their line.
    vertices, colors = _read_vertices(lines, subject)
    face_lines = lines.of_kind(b"f")
    references, sizes = _read_faces(lines, face_lines, subject)
    if len(sizes) != len(face_lines):
        raise InputError(subject, expected="corners in each f line", received="f lines without any")
    # The line of each corner, (C,).
    corner_lines = np.repeat(face_lines, sizes)
    corners = _resolve(references[:, 0], lines.of_kind(b"v"), corner_lines)
    cut = cut_polygons(corners, sizes, vertices, subject=subject)
    require_indices(cut.faces, len(vertices), subject=subject)
    # Colours of the `v` lines win over materials.
    pictures = None
    if colors is None and len(cut.faces):
        placed = _places(path, lines, references[:, 1], corner_lines)
        if placed is not None:
            colors = _material_colors(path, placed, corners, vertex_count=len(vertices))
            pictures = _pictures(path, placed, cut.corners) if colors is not None else None
    return RawMesh(vertices, cut.faces, colors, source_faces=cut.source_faces, pictures=pictures)


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines of a text: the text, (L,) the start of each line after its blanks, and (L,) its end."""

    text: bytes
    starts: Int64[np.ndarray, " L"]
    ends: Int64[np.ndarray, " L"]

    @classmethod
    def of(cls, text: bytes) -> _Lines:
        text = text.removeprefix(codecs.BOM_UTF8)
        # A backslash at a line's end joins the next line to it.
        text = re.sub(rb"\\[ \t]*\r?\n", b" ", text) if b"\\" in text else text
        text = text.replace(b"\r", b"\n") if b"\r" in text else text
        text += b"\n"
        ends = np.flatnonzero(as_bytes(text) == 10) + 1
        starts = np.concatenate([[0], ends[:-1]])
        data = as_bytes(text)
        indented = IS_SPACE & (np.arange(256) != 10)
        if indented[data[starts]].any():
            words = np.flatnonzero(~indented[data])  # line ends among them: an empty line begins at its end
            starts = words[np.searchsorted(words, starts)]
        return cls(text, starts, ends)

    def of_kind(self, word: bytes) -> Int64[np.ndarray, " n"]:
        """Return the numbers of the lines whose first word is `word`."""
        return np.flatnonzero(self.kind_mask(word))

    def kind_mask(self, word: bytes) -> Bool[np.ndarray, " L"]:
        """Tell for each line whether its first word is `word`."""
        data = as_bytes(self.text)
        mask = self.ends - self.starts > len(word)
        for k, byte in enumerate(word):
            mask &= data[np.minimum(self.starts + k, len(data) - 1)] == byte
        return mask & IS_SPACE[data[np.minimum(self.starts + len(word), len(data) - 1)]]

    def blocks(self, chosen: Int64[np.ndarray, " n"], word: bytes) -> list[tuple[bytes, np.ndarray]]:
        """Return the chosen lines without first words and comments, in blocks that bound the work space.

        Each block comes with (m,) the start of each line in it.
        """
        out: list[tuple[bytes, np.ndarray]] = []
        if not len(chosen):
            return out
        size = np.cumsum(self.ends[chosen] - self.starts[chosen])
        for rows in np.split(chosen, np.flatnonzero(np.diff(size // _BLOCK)) + 1):
            # Consecutive lines are copied as one run of bytes.
            breaks = np.flatnonzero(np.diff(rows) > 1)
            first, last = rows[np.concatenate([[0], breaks + 1])], rows[np.append(breaks, len(rows) - 1)]
            runs = [self.text[a:b] for a, b in zip(self.starts[first], self.ends[last], strict=True)]
            shift = np.cumsum([0] + [len(run) for run in runs[:-1]]) - self.starts[first]
            starts = self.starts[rows] + np.repeat(shift, np.diff(np.concatenate([[0], breaks + 1, [len(rows)]])))
            # Overwrite the first word by blanks, so that only numbers remain and every line keeps its place.
            data = as_bytes(b"".join(runs)).copy()
            data[starts[:, None] + np.arange(len(word))] = ord(" ")
            text = data.tobytes()
            if b"#" in text:
                text = re.sub(rb"#[^\n]*", lambda comment: b" " * len(comment.group()), text)
            out.append((text, starts))
        return out

    def words(self, keyword: bytes) -> list[tuple[int, str]]:
        """Return the rest of each line that begins with a keyword, with the number of the line."""
        return [
            (int(k), decode_name(self.text[self.starts[k] + len(keyword) : self.ends[k]]))
            for k in self.of_kind(keyword)
        ]


def _read_vertices(lines: _Lines, subject: str) -> tuple[Float64[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"] | None]:
    places, rgb = [np.empty((0, 3))], [np.empty((0, 3))]
    for values, counts in _rows(lines, b"v", subject):
        if counts.min() < 3:
            raise InputError(subject, expected="three numbers in each v line", received=f"{counts.min()}")
        # `v x y z r g b`: (n, 3) places, and colours where a line has at least six numbers.
        first = np.cumsum(counts) - counts
        places.append(values[first[:, None] + np.arange(3)])
        colored = first[counts >= 6]
        rgb.append(values[colored[:, None] + np.arange(3, 6)])
    vertices, colors = np.concatenate(places), np.concatenate(rgb)
    if not len(colors):
        return vertices, None
    if len(colors) < len(vertices):
        warn(f"{subject}: colours of {len(colors)} of {len(vertices)} vertices are left out, the others have none")
        return vertices, None
    return vertices, color_bytes(colors, subject=subject)


def _rows(lines: _Lines, word: bytes, subject: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the numbers (n,) of all lines of a kind, block by block, and their count in each line (m,)."""
    out = []
    for text, starts in lines.blocks(lines.of_kind(word), word):
        values = parse_numbers(text, subject=f"{subject}: {word.decode()} lines")
        out.append((values, count_between(word_starts(text), starts)))
    return out


def _read_faces(
    lines: _Lines, face_lines: Int64[np.ndarray, " F"], subject: str
) -> tuple[Int64[np.ndarray, "C 2"], Int64[np.ndarray, " F"]]:
    """Return vertex and texture coordinate of each corner as the file counts them (0: none), and corners per line."""
    references, sizes = [np.empty((0, 2), np.int64)], [np.empty(0, np.int64)]
    for text, starts in lines.blocks(face_lines, b"f"):
        while b"//" in text:  # an omitted reference
            text = text.replace(b"//", b"/0/")
            starts = np.concatenate([[0], np.flatnonzero(as_bytes(text) == 10)[:-1] + 1])
        corners = word_starts(text)
        plain = text.replace(b"/", b" ")
        numbers = parse_numbers(plain, subject=f"{subject}: f lines")
        if not (np.abs(numbers) < 2**53).all() or (numbers != np.rint(numbers)).any():
            raise InputError(f"{subject}: f lines", expected="whole numbers", received="others")
        places = word_starts(plain)
        corner = np.searchsorted(corners, places, side="right") - 1
        if (corner < 0).any() or not np.isin(corners, places).all():
            raise InputError(f"{subject}: f lines", expected="corners that name a vertex", received="others")
        # The slot of a number is the count of slashes before it in its corner: vertex/texture/normal.
        slashes = np.flatnonzero(as_bytes(text) == 47)
        slot = np.searchsorted(slashes, places) - np.searchsorted(slashes, corners)[corner]
        block = np.zeros((len(corners), 2), np.int64)
        kept = slot < 2
        block[corner[kept], slot[kept]] = numbers[kept]
        references.append(block)
        sizes.append(count_between(corners, starts))
    return np.concatenate(references), np.concatenate(sizes)


def _resolve(
    references: Int64[np.ndarray, " C"], defined: Int64[np.ndarray, " n"], corner_lines: Int64[np.ndarray, " C"]
) -> Int64[np.ndarray, " C"]:
    """Convert references to indices from 0 (-1: none); a negative one counts back from its own line."""
    if len(references) and references.min() < 0:
        back = references < 0
        # The number of vertices defined before the face's line; reference -1 is the last of them.
        known = np.searchsorted(defined, corner_lines[back])
        references = references.copy()
        references[back] = np.maximum(known + references[back] + 1, 0)
    return references - 1


@dataclass(frozen=True, eq=False)
class _Places:
    """Materials and texture coordinates of the C corners: (C,) material (-1: none), (T, 2) coordinates of the
    whole file and (C,) their row (-1: none)."""

    materials: list[Material]
    used: Int64[np.ndarray, " C"]
    uv: Float64[np.ndarray, "T 2"]
    index: Int64[np.ndarray, " C"]

    def at(self, chosen: np.ndarray, material: Material) -> Float64[np.ndarray, "n 2"]:
        """Return the texture coordinates of corners as a material places them."""
        with np.errstate(all="ignore"):
            return self.uv[self.index[chosen]] * material.scale + material.offset


def _places(
    path: Path, lines: _Lines, uv_references: Int64[np.ndarray, " C"], corner_lines: Int64[np.ndarray, " C"]
) -> _Places | None:
    """Return the materials and texture coordinates of all corners; None for a file that uses no materials."""
    uses, libraries = lines.words(b"usemtl"), lines.words(b"mtllib")
    if not uses or not libraries:
        return None
    known = read_materials(path, [name for _, name in libraries])
    # Names of one material are one: files have been seen with a name for every face.
    materials, names = list[Material](), dict[str, int]()
    places: dict[tuple[object, ...], int] = {}
    for name in dict.fromkeys(name for _, name in uses):
        material = known.get(name, Material())
        names[name] = places.setdefault(material.key, len(materials))
        materials += [material] * (names[name] == len(materials))
    # The last `usemtl` before the face's line is in force; -1 before the first.
    use = np.searchsorted([line for line, _ in uses], corner_lines) - 1
    used = np.where(use >= 0, np.array([names[name] for _, name in uses])[use], -1)
    # Texture coordinates of the whole file, (T, 2); a third coordinate is left out.
    rows = _rows(lines, b"vt", f"mesh file {path}")
    uv = np.concatenate([np.empty((0, 2))] + [_first_two(values, counts) for values, counts in rows])
    index = _resolve(uv_references, lines.of_kind(b"vt"), corner_lines)
    index = np.where(index < len(uv), index, -1)
    return _Places(materials, used, uv, index)


def _material_colors(
    path: Path, placed: _Places, corners: Int64[np.ndarray, " C"], *, vertex_count: int
) -> UInt8[np.ndarray, "N 3"] | None:
    """Return vertex colours by the materials, averaged over the corners of a vertex; None if no material has any."""
    inside = np.flatnonzero((corners >= 0) & (corners < vertex_count))  # others belong to faces that were left out
    vertex, used = corners[inside], placed.used[inside]
    # A vertex between two materials takes the material of its first corner.
    first = np.zeros(vertex_count, np.int64)
    vertices, places = np.unique(vertex, return_index=True)
    first[vertices] = used[places]
    used = np.where(used == first[vertex], used, -1)
    colors, found = np.full((vertex_count, 3), MISSING_GRAY, np.uint8), False
    pictures = TextureCache(f"mesh file {path}")
    # Corners sorted by material, so that each texture is decoded and sampled once.
    order = np.argsort(used, kind="stable")
    bounds = np.searchsorted(used[order], np.arange(len(placed.materials) + 1))
    # One material at a time: texture at the corners' coordinates, else the plain colour.
    for material, start, end in zip(placed.materials, bounds[:-1], bounds[1:], strict=True):
        chosen = inside[order[start:end]]
        if material.picture is not None:
            picture = pictures.load(path, material.picture)
            chosen = chosen[placed.index[chosen] >= 0]
            if picture is not None:
                sampled = sample_texture(picture, placed.at(chosen, material), wrap=_wrap(material))
                at, mean = average_corner_colors(corners[chosen], sampled)
                colors[at] = mean
                # A file without texture coordinates has no colours, whatever its materials name.
                found = found or len(at) > 0
        elif material.color is not None:
            colors[corners[chosen]] = material.color
            found = True
    return colors if found else None


def _pictures(path: Path, placed: _Places, corners: Int64[np.ndarray, "M 3"]) -> FacePictures | None:
    """Return the textures of triangles, given as places in the list of corners; None if none has one."""
    uv, picture = np.zeros((len(corners), 3, 2), np.float32), np.full(len(corners), -1)
    load, wraps = list[Callable[[], np.ndarray]](), list[tuple[str, str]]()
    complete = (placed.index[corners] >= 0).all(axis=1)
    # Triangles sorted by material, because a file may have as many materials as faces.
    used = placed.used[corners[:, 0]]
    order = np.argsort(used, kind="stable")
    bounds = np.searchsorted(used[order], np.arange(len(placed.materials) + 1))
    for material, start, end in zip(placed.materials, bounds[:-1], bounds[1:], strict=True):
        found = None if material.picture is None else file_beside(path, material.picture)
        faces = order[start:end]
        faces = faces[complete[faces]]
        if found is None or not len(faces):
            continue
        places = placed.at(corners[faces].ravel(), material)
        uv[faces] = bounded_places(places * [1, -1] + [0, 1]).reshape(-1, 3, 2)
        picture[faces] = len(load)
        load.append(partial(picture_bytes, found))
        wraps.append(_wrap(material))
    return FacePictures(uv, picture, tuple(load), tuple(wraps)) if load else None


def _wrap(material: Material) -> tuple[str, str]:
    return (CLAMP, CLAMP) if material.clamp else (REPEAT, REPEAT)


def _first_two(values: Float64[np.ndarray, " n"], counts: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 2"]:
    """Return the first two numbers of each line; a missing second one is 0."""
    values = np.append(values, [0.0, 0.0])
    first = np.cumsum(counts) - counts
    return np.stack([np.where(counts > k, values[first + k], 0.0) for k in range(2)], axis=1)
