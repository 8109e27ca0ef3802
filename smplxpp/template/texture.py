"""Pictures on a template's surface: where its faces lie in them, their files, and the vertices that seams split."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from smplxpp.core import InputError, TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.files.image_file import decode_image
from smplxpp.core.mesh_files.texture import CLAMP, sample_bilinear

if TYPE_CHECKING:
    from smplxpp.template.template import Template

TEXTURE_SIZES = (0, 1024, 2048, 4096)
"""Pixels a side that a build offers; 0: no texture."""
LAYOUTS = ("one", "part")
"""One picture for all parts, or one a part, that of the body in its own file's layout."""
# JPEG without chroma subsampling, so that red seams stay sharp: 45 dB against the pixels, a quarter of a PNG's bytes.
_JPEG = {"format": "JPEG", "quality": 93, "subsampling": 0}
_KEYS = ("texture_uv", "texture_face_uv", "texture_picture")


@dataclass(frozen=True, eq=False, kw_only=True)
class Texture:
    """Colours, and normals if there are any, of a template's surface in K square pictures.

    Attributes:
        uv: texture coordinates in [0, 1], u to the right, v downwards from the upper edge, as glTF has them.
        face_uv: row of `uv` of each corner of the template's faces.
        picture: number of the picture of each part.
        colors: K pictures, sRGB, encoded as JPEG files.
        normals: K pictures in tangent space (+Y upwards, as glTF has them), encoded as PNG files; () without any.

    Example:
        >>> template.texture.color_image(0).shape  # doctest: +SKIP
        (2048, 2048, 3)
    """

    uv: Float64[np.ndarray, "U 2"]
    face_uv: Int64[np.ndarray, "F 3"]
    picture: Int64[np.ndarray, " P"]
    colors: tuple[bytes, ...]
    normals: tuple[bytes, ...] = ()

    def __post_init__(self) -> None:
        for name, dtype in (("uv", np.float64), ("face_uv", np.int64), ("picture", np.int64)):
            array: np.ndarray = np.array(getattr(self, name), dtype=dtype, order="C")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        _require(self.uv.ndim == 2 and self.uv.shape[1] == 2, "uv", "shape (U, 2)", f"shape {self.uv.shape}")
        inside = bool(np.isfinite(self.uv).all()) and bool(((self.uv >= 0) & (self.uv <= 1)).all())
        _require(inside, "uv", "coordinates in [0, 1]", "others")
        _require(_below(self.face_uv, len(self.uv)), "face_uv", f"rows of uv, below {len(self.uv)}", "others")
        _require(_below(self.picture, len(self.colors)), "picture", f"below {len(self.colors)}", "others")
        _require(
            len(self.normals) in (0, len(self.colors)), "normals", f"{len(self.colors)} or none", str(len(self.normals))
        )

    def color_image(self, picture: int) -> UInt8[np.ndarray, "S S 3"]:
        """Decode a picture of colours, sRGB.

        Raises:
            InputError: damaged bytes.
        """
        return _decoded(self.colors[picture])

    @property
    def size(self) -> int:
        """Pixels a side of the pictures."""
        return decode_image(self.colors[0], subject="texture").size[0]

    def resized(self, size: int) -> Texture:
        """Return the texture with pictures of `size` pixels a side; larger ones than there are stay as they are."""
        if size >= self.size:
            return self
        import PIL.Image

        def smaller(data: bytes, write: dict) -> bytes:
            image = decode_image(data, subject="texture").convert("RGB")
            return _encoded(image.resize((size, size), PIL.Image.Resampling.BOX), write)

        colors = tuple(smaller(data, _JPEG) for data in self.colors)
        return replace(self, colors=colors, normals=tuple(smaller(data, {"format": "PNG"}) for data in self.normals))

    def of_faces(self, kept: Bool[np.ndarray, " F"], parts: int) -> Texture:
        """Return the texture of some faces, which lie in the first `parts` parts."""
        return replace(self, face_uv=self.face_uv[kept], picture=self.picture[:parts])


def encode_texture(
    colors: list[UInt8[np.ndarray, "S S 3"]], normals: list[UInt8[np.ndarray, "S S 3"]]
) -> tuple[tuple[bytes, ...], tuple[bytes, ...]]:
    """Encode pictures of colours as JPEG and of normals as PNG, whose hard edges JPEG would ring at."""
    import PIL.Image

    jpegs = tuple(_encoded(PIL.Image.fromarray(picture), _JPEG) for picture in colors)
    png = {"format": "PNG", "compress_level": 4}
    return jpegs, tuple(_encoded(PIL.Image.fromarray(picture), png) for picture in normals)


def split_at_seams(
    faces: Int64[np.ndarray, "M 3"], face_uv: Int64[np.ndarray, "M 3"], count: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int64[np.ndarray, "M 3"]]:
    """Split vertices that have several places in the pictures, as formats with one index a corner need it.

    The first `count` vertices stay in their order, each with the place of its first corner; copies follow them.

    Args:
        faces: indices below `count`.
        face_uv: row of the texture coordinates of each corner.
        count: number of vertices.

    Returns:
        The vertex that each of the n is a copy of, its row of the texture coordinates (-1: no face uses it), and the
        faces over the n.
    """
    width = int(face_uv.max(initial=0)) + 1
    pairs, first, corner = np.unique(faces.ravel() * width + face_uv.ravel(), return_index=True, return_inverse=True)
    vertex, place = pairs // width, pairs % width
    # The pair that a vertex meets first stands for it; the other pairs are its copies, in the order of the faces.
    order = np.argsort(first, kind="stable")
    seen, leading = np.unique(vertex[order], return_index=True)
    own = order[leading]
    copy = np.ones(len(pairs), dtype=bool)
    copy[own] = False
    copies = order[copy[order]]
    number = np.empty(len(pairs), np.int64)
    number[own], number[copies] = seen, count + np.arange(len(copies))
    source = np.concatenate([np.arange(count), vertex[copies]])
    rows = np.full(len(source), -1, np.int64)
    rows[number] = place
    return source, rows, number[corner.reshape(faces.shape)]


def picture_files(texture: Texture, stem: str) -> dict[str, bytes]:
    """Return the pictures by the names of files beside one of this stem: colours, then normals, as they are numbered.

    Example:
        >>> list(picture_files(template.texture, "anna"))  # doctest: +SKIP
        ['anna_color.jpg', 'anna_normal.png']
    """
    several = len(texture.colors) > 1
    named = ((texture.colors, "color", "jpg"), (texture.normals, "normal", "png"))
    return {
        f"{stem}_{kind}{f'_{k}' if several else ''}.{suffix}": data
        for pictures, kind, suffix in named
        for k, data in enumerate(pictures)
    }


@dataclass(frozen=True, eq=False)
class PartSurface:
    """A part of a template as formats with one index a corner hold it.

    Attributes:
        rows: vertex of the template of each of the n; the part's own in order, then copies at seams.
        faces: over the n.
        uv: v downwards; None without a texture.
        tangents: and signs of the bitangents (`corner_tangents`); None without normals.
    """

    rows: Int64[np.ndarray, " n"]
    faces: Int64[np.ndarray, "M 3"]
    uv: Float64[np.ndarray, "n 2"] | None
    tangents: Float64[np.ndarray, "n 4"] | None


def part_surface(template: Template, part: int) -> PartSurface | None:
    """Return a part with its vertices split at the seams of its texture; None for a part without faces."""
    chosen = template.part_faces(template.part_names[part])
    if not chosen.any():
        return None
    # Parts follow each other in the vertices, so that the part's own indices are these.
    rows = np.flatnonzero(template.vertex_part == part)
    faces, texture = template.faces[chosen] - rows[0], template.texture
    if texture is None:
        return PartSurface(rows, faces, None, None)
    source, place, faces = split_at_seams(faces, texture.face_uv[chosen], len(rows))
    uv = np.where(place[:, None] >= 0, texture.uv[place], 0.0)
    if not texture.normals:
        return PartSurface(rows[source], faces, uv, None)
    tangents = np.tile([1.0, 0.0, 0.0, 1.0], (len(source), 1))
    mesh = TriangleMesh(template.vertices, template.faces[chosen])
    tangents[faces] = corner_tangents(mesh, texture.uv, texture.face_uv[chosen])
    return PartSurface(rows[source], faces, uv, tangents)


def corner_tangents(
    mesh: TriangleMesh, uv: Float64[np.ndarray, "U 2"], face_uv: Int64[np.ndarray, "F 3"]
) -> Float64[np.ndarray, "F 3 4"]:
    """Return the tangent at each corner of the faces, and the sign of the bitangent, as glTF's TANGENT has them.

    The tangent points to where u grows, perpendicular to the vertex's normal; corners of a vertex that share their
    texture coordinates and the sign share it. `bitangent = cross(normal, tangent) * sign` points up in the picture.

    Args:
        mesh: the surface that normals were baked on, or the one that is written.
        uv: texture coordinates, v downwards.
        face_uv: their rows at the corners.
    """
    corners = uv[face_uv] * [1.0, -1.0]
    (a, b), edges = (corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), mesh.triangles[:, 1:]
    edges = edges - mesh.triangles[:, :1]
    # dP/du of each face times its area in the picture, which leaves the direction and weighs large faces more.
    flat = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    along = edges[:, 0] * b[:, 1:] - edges[:, 1] * a[:, 1:]
    along = np.where(flat[:, None] < 0, -along, along)
    # Mean over the corners with the same vertex, place and sign.
    sign = np.where(flat < 0, -1.0, 1.0)
    key = (mesh.faces * len(uv) + face_uv) * 2 + (sign < 0)[:, None]
    _, group = np.unique(key.ravel(), return_inverse=True)
    group = group.reshape(-1)
    total = np.stack([np.bincount(group, np.repeat(along[:, k], 3)) for k in range(3)], axis=1)[group]
    normal = mesh.vertex_normals[mesh.faces.ravel()]
    tangent = total - np.einsum("nd,nd->n", total, normal)[:, None] * normal
    # Any direction across the normal where the picture gives none.
    weak = row_lengths(tangent) < 1e-12 * max(float(row_lengths(tangent).max(initial=0.0)), 1e-300)
    across = np.cross(normal[weak], np.eye(3)[np.abs(normal[weak]).argmin(axis=1)])
    tangent[weak] = np.where(row_lengths(across)[:, None] > 0, across, [1.0, 0.0, 0.0])
    out = np.concatenate([normalize_rows(tangent), np.repeat(sign, 3)[:, None]], axis=1)
    return out.reshape(-1, 3, 4)


def texture_paint(
    template: Template,
) -> Callable[[Int64[np.ndarray, " T"], Float64[np.ndarray, "T 3"]], UInt8[np.ndarray, "T 3"]] | None:
    """Return what gives the sRGB of points on a template, as faces and barycentric coordinates; None without texture.

    Example:
        >>> paint = texture_paint(template)  # doctest: +SKIP
        >>> picture = render_shaded(template.mesh, camera, paint=paint)  # doctest: +SKIP
    """
    texture = template.texture
    if texture is None:
        return None
    images = [texture.color_image(k) for k in range(len(texture.colors))]

    def paint(face: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        uv = np.einsum("tk,tkd->td", barycentric, texture.uv[texture.face_uv[face]])
        picture = texture.picture[template.vertex_part[template.faces[face, 0]]]
        out = np.zeros((len(face), 3), np.uint8)
        for k, image in enumerate(images):
            out[picture == k] = sample_bilinear(image, uv[picture == k], wrap=(CLAMP, CLAMP))
        return out

    return paint


def texture_arrays(texture: Texture) -> dict[str, np.ndarray]:
    """Return the arrays of a texture as a template's file names them."""
    arrays = dict(zip(_KEYS, (texture.uv, texture.face_uv, texture.picture), strict=True))
    for name, files in (("color", texture.colors), ("normal", texture.normals)):
        arrays |= {f"texture_{name}_{k}": np.frombuffer(data, np.uint8) for k, data in enumerate(files)}
    return arrays


def texture_from_arrays(arrays: Mapping[str, np.ndarray]) -> Texture | None:
    """Return the texture in a template's file; None where it has none.

    Raises:
        InputError: arrays of other kinds, or that do not fit each other.
    """
    if not any(key in arrays for key in _KEYS):
        return None
    for key, kinds in zip(_KEYS, ("f", "iu", "iu"), strict=True):
        if key not in arrays or arrays[key].dtype.kind not in kinds:
            raise InputError(key, expected="numbers of a texture", received="none, or of another type")
    files = {
        name: tuple(
            arrays[f"texture_{name}_{k}"].astype(np.uint8).tobytes()
            for k in range(len(arrays))
            if f"texture_{name}_{k}" in arrays
        )
        for name in ("color", "normal")
    }
    return Texture(
        uv=arrays["texture_uv"],
        face_uv=arrays["texture_face_uv"],
        picture=arrays["texture_picture"],
        colors=files["color"],
        normals=files["normal"],
    )


def _encoded(image: object, options: dict) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, **options)  # type: ignore[attr-defined]
    return buffer.getvalue()


def _decoded(data: bytes) -> UInt8[np.ndarray, "S S 3"]:
    return np.array(decode_image(data, subject="texture").convert("RGB"))


def _below(rows: np.ndarray, bound: int) -> bool:
    return not rows.size or bool(rows.min() >= 0 and rows.max() < bound)


def _require(condition: bool, subject: str, expected: str, received: str) -> None:
    if not condition:
        raise InputError(f"texture: {subject}", expected=expected, received=received)
