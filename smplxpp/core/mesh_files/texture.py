"""Pictures that mesh files name: found inside the file's folder, decoded within bounds, sampled at the vertices."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import open_image
from smplxpp.core.files.paths import path_inside, regular_file
from smplxpp.core.mesh_files.raw_mesh import warn

if TYPE_CHECKING:
    from PIL.Image import Image

# The colour of a vertex that has none in a file of which others have.
LOST = 128
# What a picture shows beyond its edges.
REPEAT, MIRROR, CLAMP = "repeat", "mirror", "clamp"
# A hundred pictures of 4096 x 4096 are fewer.
_MOST_DECODED = 2_000_000_000


def beside(path: Path, name: str) -> Path | None:
    """The file that a mesh file names: inside the mesh file's folder, or None.

    Names as Windows writes them are understood. One that leads out of the folder, as of another machine's disk, is
    looked for beside the mesh file under its last part; nothing outside the folder is ever opened.
    """
    name = name.strip().strip('"')
    for candidate in (name, name.replace("\\", "/").rpartition("/")[2]):
        try:
            return regular_file(path_inside(path.parent, candidate))
        except InputError:
            continue
    return None


class Pictures:
    """The pictures of a mesh file, one in memory at a time, and in all no more pixels than real files have.

    Args:
        subject: the mesh file, for messages.
    """

    def __init__(self, subject: str) -> None:
        self._subject, self._pixels = subject, 0
        self._key: object = None
        self._last = np.empty((0, 0, 3), np.uint8)

    def get(self, key: object, decode: Callable[[], Image]) -> UInt8[np.ndarray, "H W 3"]:
        """The picture of a key: the last one again, or decoded.

        Raises:
            InputError: what `decode` raises, or a file that asks for more pixels than it may.
        """
        if self._key is None or key != self._key:
            if self._pixels > _MOST_DECODED:
                raise InputError(self._subject, expected=f"at most {_MOST_DECODED} pixels of pictures", received="more")
            picture = np.array(decode().convert("RGB"))
            self._key, self._last = key, picture
            self._pixels += picture.shape[0] * picture.shape[1]
        return self._last

    def beside(self, path: Path, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """The picture that a mesh file names; None, with a warning, where it is missing or cannot be used."""
        found = beside(path, name)
        if found is None:
            warn(f"{self._subject}: its colours are lost: the picture {name[:200]!r} is not in its folder")
            return None
        try:
            return self.get(found, lambda: open_image(found))
        except InputError as error:
            warn(f"{self._subject}: its colours are lost: {error}")
            return None


def sample_texture(
    picture: UInt8[np.ndarray, "H W 3"],
    uv: Float[np.ndarray, "N 2"],
    *,
    top_down: bool = False,
    wrap: tuple[str, str] = (REPEAT, REPEAT),
) -> UInt8[np.ndarray, "N 3"]:
    """The colours of the texels that hold the coordinates.

    Args:
        picture: rows from the top.
        uv: texture coordinates; v is 0 at the bottom row's lower edge. NaN and infinity count as 0.
        top_down: v is 0 at the top row's upper edge, as in glTF.
        wrap: what lies beyond [0, 1] along u and v: the picture again, its mirror image and so on, or its last texel.
    """
    uv = np.where(np.isfinite(uv), uv, 0.0)
    u, v = (_within(uv[:, k], wrap[k]) for k in range(2))
    height, width = picture.shape[:2]
    down = v if top_down else 1.0 - v
    column = np.minimum((u * width).astype(np.int64), width - 1)
    return picture[np.minimum((down * height).astype(np.int64), height - 1), column]


def _within(x: Float[np.ndarray, " N"], wrap: str) -> Float[np.ndarray, " N"]:
    """Coordinates brought into [0, 1]; those that are there stay, 1 among them."""
    if wrap == CLAMP:
        return np.clip(x, 0.0, 1.0)
    inside = (x >= 0) & (x <= 1)
    if wrap == MIRROR:
        return np.where(inside, x, 1.0 - np.abs(x % 2.0 - 1.0))
    return np.where(inside, x, x % 1.0)


def mean_of_corners(
    vertices: Int64[np.ndarray, " C"], colors: UInt8[np.ndarray, "C 3"]
) -> tuple[Int64[np.ndarray, " n"], UInt8[np.ndarray, "n 3"]]:
    """The vertices that occur, and each one's mean of the colours of its corners.

    A vertex on a seam of the texture has several places in the picture, whose colours differ where the picture was
    packed or painted loosely.
    """
    found, place = np.unique(vertices, return_inverse=True)
    corners = np.bincount(place, minlength=len(found))
    sums = np.stack([np.bincount(place, colors[:, k], minlength=len(found)) for k in range(3)], axis=1)
    return found, np.rint(sums / corners[:, None]).astype(np.uint8)
