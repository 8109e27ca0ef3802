"""Hold the arrays of a mesh file before any check, and the functions that its readers share."""

from __future__ import annotations

import unicodedata
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, Int64, Integer, Num, UInt8

from smplxpp.core.errors import GeometryWarning, InputError


@dataclass(frozen=True, eq=False)
class FacePictures:
    """Textures of a mesh file and where its faces lie in them; they are decoded when they are asked for.

    Attributes:
        uv: (M, 3, 2) texture coordinates of the corners, v downwards from the upper edge.
        picture: (M,) texture of each face, -1 for a face without one.
        load: functions that return the textures, (H, W, 3) uint8 sRGB.
        wraps: what is outside [0, 1] along u and v of each texture: "repeat", "mirror" or "clamp".
    """

    uv: Float32[np.ndarray, "M 3 2"]
    picture: Int64[np.ndarray, " M"]
    load: tuple[Callable[[], UInt8[np.ndarray, "H W 3"]], ...]
    wraps: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class FileRig:
    """The skeleton of a mesh file and its skin weights as they are stored, before any check.

    Attributes:
        names: of the J joints, parents before children.
        parents: index of the nearest joint above, -1 without one.
        world: transform of each joint to the world, in the pose that the file shows.
        column_joint: joint of each column of the weights; skins may bind one joint differently.
        inverse_bind: inverse bind matrix of each column.
        columns: (N, K) columns that move each vertex.
        weights: (N, K) their weights, 0 where a vertex has fewer; neither checked nor divided by their sum.
        bound: (N, 3) vertices before they are skinned.
    """

    names: tuple[str, ...]
    parents: Int64[np.ndarray, " J"]
    world: Float64[np.ndarray, "J 4 4"]
    column_joint: Int64[np.ndarray, " C"]
    inverse_bind: Float64[np.ndarray, "C 4 4"]
    columns: Int64[np.ndarray, "N K"]
    weights: Float64[np.ndarray, "N K"]
    bound: Float64[np.ndarray, "N 3"]

    def posed(self, world: Float64[np.ndarray, "J 4 4"]) -> Float64[np.ndarray, "N 3"]:
        """Return the vertices for other transforms of the joints; those without weights stay where they are stored."""
        return blended(self.bound, self.columns, self.weights, world[self.column_joint] @ self.inverse_bind)


@dataclass(frozen=True, eq=False)
class RawMesh:
    """The arrays of a mesh file before any check.

    Attributes:
        vertices: (N, 3) float64, all vertices of the file in its order; may contain NaN.
        faces: (M, 3) int64, the faces of the file in its order, polygons cut into triangles.
        vertex_colors: (N, 3) uint8 or None.
        vertex_properties: other arrays (N,) of vertices by name (PLY).
        face_properties: other arrays (M,) of faces by name (PLY).
        source_faces: (M,) int64, the file's face of each triangle; None if all are triangles.
        vertex_normals: (N, 3) float64 of a file without faces (PLY, npz); else None.
        pictures: the textures that colour the faces (OBJ, glTF); None without any.
        part_names: of the file's meshes (glTF).
        face_part: (M,) the mesh of each face; None for files that do not name any.
        rig: skeleton and skin weights (glTF); None without any.
    """

    vertices: Float64[np.ndarray, "N 3"]
    faces: Int64[np.ndarray, "M 3"]
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None
    vertex_properties: dict[str, np.ndarray] = field(default_factory=dict)
    face_properties: dict[str, np.ndarray] = field(default_factory=dict)
    source_faces: Int64[np.ndarray, " M"] | None = None
    vertex_normals: Float64[np.ndarray, "N 3"] | None = None
    pictures: FacePictures | None = None
    part_names: tuple[str, ...] = ()
    face_part: Int64[np.ndarray, " M"] | None = None
    rig: FileRig | None = None

    @property
    def is_cloud(self) -> bool:
        """Whether the file has points but no faces."""
        return not len(self.faces)


def blended(
    points: Float64[np.ndarray, "n 3"],
    columns: Int64[np.ndarray, "n k"],
    weights: Float64[np.ndarray, "n k"],
    matrices: Float64[np.ndarray, "C 4 4"],
) -> Float64[np.ndarray, "n 3"]:
    """Pose points by linear blend skinning; weights are divided by their sum, because quantised ones do not sum to one.

    Points whose weights sum to 0 or less stay.
    """
    out = np.zeros_like(points)
    for column, weight in zip(columns.T, weights.T, strict=True):
        moved = np.einsum("nij,nj->ni", matrices[column, :3, :3], points) + matrices[column, :3, 3]
        out += weight[:, None] * moved
    total = weights.sum(axis=1, keepdims=True)
    return np.divide(out, total, out=points.copy(), where=total > 0)


def require_indices(faces: Integer[np.ndarray, "*n"], count: int, *, subject: str, kind: str = "faces") -> None:
    """Refuse indices of vertices outside [0, count).

    Raises:
        InputError: an index outside; the message names the range found.
    """
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise InputError(
            f"{subject}: {kind}",
            expected=f"indices in [0, {count})",
            received=f"indices in [{faces.min()}, {faces.max()}]",
            remedy="the file is damaged or incomplete: export it again",
        )


def require_coordinate_range(vertices: Num[np.ndarray, "N 3"], *, subject: str) -> None:
    """Refuse finite coordinates that are too large to compute with; NaN and infinity are left to the repair.

    Raises:
        InputError: a coordinate over 1e12.
    """
    # float64 still resolves tenths of a millimetre here, and sums of squares do not overflow even in float32.
    largest = 1e12
    far = (np.isfinite(vertices) & (np.abs(vertices) > largest)).any(axis=1)
    if far.any():
        row = int(np.argmax(far))
        place = ", ".join(f"{value:g}" for value in vertices[row])
        raise InputError(
            f"{subject}: vertices",
            expected=f"coordinates within {largest:g}",
            received=f"{int(far.sum())} vertices outside, first at index {row}: ({place})",
            remedy="delete stray vertices and move the surface to the origin",
        )


def color_bytes(colors: Num[np.ndarray, "N C"], *, subject: str) -> UInt8[np.ndarray, "N 3"] | None:
    """Convert colours to bytes: unsigned integers by their range, floats from [0, 1] or, if any is larger, [0, 255].

    Args:
        colors: (N, C >= 3).
        subject: name of the file in the warning.

    Returns:
        (N, 3) uint8; None, with a warning, if a colour is NaN or infinite.
    """
    rgb = np.asarray(colors)[:, :3]
    if rgb.dtype.kind == "u":
        # Unsigned integers are scaled by the maximum of their type: 65535 becomes 255.
        top = np.iinfo(rgb.dtype).max
        return rgb if top == 255 else np.rint(rgb * (255.0 / top)).astype(np.uint8)
    if not np.isfinite(rgb).all():
        warn(f"{subject}: vertex colours with NaN or infinity are left out")
        return None
    # Floats are shares if none exceeds 1, else bytes.
    if rgb.dtype.kind == "f":
        rgb = rgb * (255.0 if rgb.size and rgb.max() <= 1.0 else 1.0) + 0.5
    return np.clip(rgb, 0, 255).astype(np.uint8)


def warn(message: str) -> None:
    """Warn of a repair or a loss with a GeometryWarning."""
    warnings.warn(message, GeometryWarning, stacklevel=3)


def decode_name(data: bytes) -> str:
    """Decode a name in a mesh file: UTF-8, else a letter a byte, so that names that differ stay different."""
    try:
        return unicodedata.normalize("NFC", data.decode("utf-8")).strip()
    except UnicodeDecodeError:
        return data.decode("latin-1").strip()


IS_SPACE = np.isin(np.arange(256), (9, 10, 11, 12, 13, 32))
"""Whether a byte is white space: tab, line feed, vertical tab, form feed, carriage return, space."""


def parse_numbers(text: bytes, *, subject: str) -> Float64[np.ndarray, " n"]:
    """Parse a text that consists of numbers, separated by blanks and line ends.

    Raises:
        InputError: a word that is not a number; the message names it.
    """
    count = len(word_starts(text))
    # numpy only warns of a bad word, and reads "1-2" as two numbers; comparing counts finds both.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ") if count else np.empty(0)
        except ValueError:
            values = np.empty(0)
    if len(values) != count:
        raise InputError(subject, expected="numbers", received=_first_bad_word(text))
    return values


def word_starts(text: bytes) -> Int64[np.ndarray, " n"]:
    """Return the start of each word of a text."""
    space = IS_SPACE[as_bytes(text)]
    return np.flatnonzero(~space & np.concatenate([[True], space[:-1]]))


def count_between(places: Int64[np.ndarray, " n"], starts: Int64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """Count the increasing places between each start and the next."""
    return np.diff(np.append(np.searchsorted(places, starts), len(places)))


def as_bytes(text: bytes) -> UInt8[np.ndarray, " n"]:
    """View a text as an array of bytes, without a copy."""
    return np.frombuffer(text, dtype=np.uint8)


def _first_bad_word(text: bytes) -> str:
    for word in text.split():
        try:
            float(word)
        except ValueError:
            return f"the word {word[:40].decode('latin1')!r}"
    return "words that are no numbers"
