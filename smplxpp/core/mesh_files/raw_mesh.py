"""The arrays of a mesh file before any check, and what all readers of such files share."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64, Integer, Num, UInt8

from smplxpp.core.errors import GeometryWarning, InputError

# float64 still tells tenths of a millimetre at this distance, and no sum of squares overflows even in float32.
LARGEST_COORDINATE = 1e12


@dataclass(frozen=True, eq=False)
class RawMesh:
    """The arrays of a mesh file before any check.

    Attributes:
        vertices: (N, 3) float64, may hold NaN; the file's vertices, all of them, in its order.
        faces: (M, 3) int64; the file's faces in its order, polygons cut into fans in their place.
        vertex_colors: (N, 3) uint8 or None.
        vertex_properties, face_properties: other per-element arrays by name (PLY); (N,) and (M,).
        source_faces: (M,) int64, the file's face that each triangle comes from; None where all are triangles.
        vertex_normals: (N, 3) float64 of a file without faces (PLY, npz), as it has them; else None.
    """

    vertices: Float64[np.ndarray, "N 3"]
    faces: Int64[np.ndarray, "M 3"]
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None
    vertex_properties: dict[str, np.ndarray] = field(default_factory=dict)
    face_properties: dict[str, np.ndarray] = field(default_factory=dict)
    source_faces: Int64[np.ndarray, " M"] | None = None
    vertex_normals: Float64[np.ndarray, "N 3"] | None = None

    @property
    def is_cloud(self) -> bool:
        """Points without faces."""
        return not len(self.faces)


@dataclass(frozen=True, eq=False)
class Fans:
    """Polygons as triangles.

    Attributes:
        faces: (M, 3) vertex indices; polygon (a, b, c, d) gives (a, b, c), (a, c, d).
        corners: (M, 3) places of the same corners in the flat list of all corners.
        polygons: (M,) the polygon that each triangle comes from.
        count: of polygons.
    """

    faces: Int64[np.ndarray, "M 3"]
    corners: Int64[np.ndarray, "M 3"]
    polygons: Int64[np.ndarray, " M"]
    count: int

    @property
    def source_faces(self) -> Int64[np.ndarray, " M"] | None:
        """The polygons, None where each is one triangle."""
        return None if np.array_equal(self.polygons, np.arange(self.count)) else self.polygons


def fan_triangles(corners: Integer[np.ndarray, " C"], sizes: Integer[np.ndarray, " F"], *, subject: str) -> Fans:
    """Cut polygons into fans, in their order; those of fewer than three corners give none, which a warning says.

    Args:
        corners: (C,) vertex indices of all polygons, one after the other.
        sizes: (F,) corners of each polygon, which sum to C.
        subject: the file, for the warning.
    """
    few = int((sizes < 3).sum())
    if few:
        warn(f"{subject}: {few} faces with fewer than three corners are left out")
    first = np.cumsum(sizes) - sizes
    triangles = np.maximum(sizes.astype(np.int64) - 2, 0)
    polygons = np.repeat(np.arange(len(sizes), dtype=np.int64), triangles)
    step = np.arange(len(polygons), dtype=np.int64) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    start = first.astype(np.int64)[polygons]
    places = np.stack([start, start + step + 1, start + step + 2], axis=1)
    return Fans(corners.astype(np.int64)[places].reshape(-1, 3), places, polygons, len(sizes))


def require_indices(faces: Integer[np.ndarray, "*n"], count: int, *, subject: str, kind: str = "faces") -> None:
    """Refuse indices outside [0, count).

    Raises:
        InputError: it names the range that was found.
    """
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise InputError(
            f"{subject}: {kind}",
            expected=f"indices in [0, {count})",
            received=f"indices in [{faces.min()}, {faces.max()}]",
            remedy="the file is damaged or incomplete: export it again",
        )


def require_reach(vertices: Num[np.ndarray, "N 3"], *, subject: str) -> None:
    """Refuse finite coordinates that are too large to compute with; NaN and infinity are left to the repair.

    Raises:
        InputError: a coordinate beyond 1e12.
    """
    far = (np.isfinite(vertices) & (np.abs(vertices) > LARGEST_COORDINATE)).any(axis=1)
    if far.any():
        row = int(np.argmax(far))
        place = ", ".join(f"{value:g}" for value in vertices[row])
        raise InputError(
            f"{subject}: vertices",
            expected=f"coordinates within {LARGEST_COORDINATE:g}",
            received=f"{int(far.sum())} vertices beyond, first at index {row}: ({place})",
            remedy="delete stray vertices and move the surface to the origin",
        )


def color_bytes(colors: Num[np.ndarray, "N C"], *, subject: str) -> UInt8[np.ndarray, "N 3"] | None:
    """Colours as 8-bit RGB: unsigned integers by their range, floats in [0, 1] or, where one is larger, in [0, 255].

    Args:
        colors: (N, C >= 3).
        subject: the file, for the warning.

    Returns:
        (N, 3) uint8; None, with a warning, where a colour is NaN or infinite.
    """
    rgb = np.asarray(colors)[:, :3]
    if rgb.dtype.kind == "u":
        top = np.iinfo(rgb.dtype).max
        return rgb if top == 255 else np.rint(rgb * (255.0 / top)).astype(np.uint8)
    if not np.isfinite(rgb).all():
        warn(f"{subject}: vertex colours with NaN or infinity are left out")
        return None
    if rgb.dtype.kind == "f":
        rgb = rgb * (255.0 if rgb.size and rgb.max() <= 1.0 else 1.0) + 0.5
    return np.clip(rgb, 0, 255).astype(np.uint8)


def warn(message: str) -> None:
    """State a repair or a loss."""
    warnings.warn(message, GeometryWarning, stacklevel=3)


# By byte: tab, line feed, vertical tab, form feed, carriage return, space.
IS_SPACE = np.isin(np.arange(256), (9, 10, 11, 12, 13, 32))


def parse_numbers(text: bytes, *, subject: str) -> Float64[np.ndarray, " n"]:
    """The numbers of a text that holds nothing else, separated by blanks and line ends.

    Raises:
        InputError: a word that is no number; it is named.
    """
    count = len(word_starts(text))
    # numpy only warns where a text goes wrong, and takes "1-2" for two numbers: their count tells both.
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
    """Where the words of a text begin."""
    space = IS_SPACE[as_bytes(text)]
    return np.flatnonzero(~space & np.concatenate([[True], space[:-1]]))


def count_between(places: Int64[np.ndarray, " n"], starts: Int64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """How many of the increasing places lie between each start and the next."""
    return np.diff(np.append(np.searchsorted(places, starts), len(places)))


def as_bytes(text: bytes) -> UInt8[np.ndarray, " n"]:
    """A text as an array, not copied."""
    return np.frombuffer(text, dtype=np.uint8)


def _first_bad_word(text: bytes) -> str:
    for word in text.split():
        try:
            float(word)
        except ValueError:
            return f"the word {word[:40].decode('latin1')!r}"
    return "words that are no numbers"
