"""Find textures inside the folder of a mesh file, decode them within bounds, and sample them at the vertices."""

from __future__ import annotations

import contextlib
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import open_image
from smplxpp.core.files.paths import path_inside, regular_file
from smplxpp.core.mesh_files.raw_mesh import warn

if TYPE_CHECKING:
    from PIL.Image import Image

MISSING_GRAY = 128
"""Gray of a vertex without a colour in a file in which other vertices have colours."""
# Encodings of names in files that are no UTF-8: Western, Chinese, Japanese, Korean and Cyrillic systems.
_ENCODINGS = ("cp1252", "gb18030", "shift_jis", "euc_kr", "big5", "cp1251")
# Wrap modes outside of [0, 1].
REPEAT, MIRROR, CLAMP = "repeat", "mirror", "clamp"


def file_beside(path: Path, name: str) -> Path | None:
    """Return the file that a mesh file names, if it is inside the mesh file's folder, else None.

    Windows paths are understood. A name that leads out of the folder, such as a path of another machine, is looked up
    beside the mesh file by its last part; nothing outside the folder is ever opened. Names of other letter case, of
    accents written otherwise, and in the encodings of other systems (`decode_name`) are found, too.
    """
    name = name.strip().strip('"')
    last = name.replace("\\", "/").rpartition("/")[2]
    for candidate in (name, last):
        try:
            return regular_file(path_inside(path.parent, candidate))
        except InputError:
            continue
    # As systems compare names that do not tell case: by the letters of the last part, in every encoding.
    wanted = {_letters(last)}
    if not last.isascii():
        for encoding in _ENCODINGS:
            with contextlib.suppress(UnicodeError):
                wanted.add(_letters(last.encode("latin-1").decode(encoding)))
    folder = path.parent / name.replace("\\", "/").rpartition("/")[0]
    for place in dict.fromkeys((folder, path.parent)):
        try:
            inside = place if place == path.parent else path_inside(path.parent, str(place.relative_to(path.parent)))
            found = [one.name for one in inside.iterdir() if _letters(one.name) in wanted]
            if found:
                return regular_file(inside / min(found))
        except (InputError, OSError, ValueError):
            continue
    return None


def _letters(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def picture_bytes(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Decode a texture; `TextureCache` warned of it already if it cannot be read.

    Raises:
        InputError: no whole image.
    """
    return np.array(open_image(path).convert("RGB"))


class TextureCache:
    """Decodes the textures of a mesh file, keeps the last one, and bounds the total number of pixels.

    Args:
        subject: name of the mesh file in messages.
    """

    def __init__(self, subject: str) -> None:
        self._subject, self._pixels = subject, 0
        self._key: object = None
        self._last = np.empty((0, 0, 3), np.uint8)

    def get(self, key: object, decode: Callable[[], Image]) -> UInt8[np.ndarray, "H W 3"]:
        """Return the texture of a key, decoding it if it is not the last one.

        Raises:
            InputError: what `decode` raises, or a file with too many pixels in all.
        """
        if self._key is None or key != self._key:
            max_pixels = 2_000_000_000  # more than a hundred textures of 4096 x 4096
            if self._pixels > max_pixels:
                raise InputError(self._subject, expected=f"at most {max_pixels} pixels of pictures", received="more")
            picture = np.array(decode().convert("RGB"))
            self._key, self._last = key, picture
            self._pixels += picture.shape[0] * picture.shape[1]
        return self._last

    def load(self, path: Path, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
        """Return the texture that a mesh file names; None, with a warning, if it is missing or unusable."""
        found = file_beside(path, name)
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
    """Return the colour of the texel at each coordinate (nearest neighbour).

    Args:
        picture: texture, rows from the top.
        uv: texture coordinates; v is 0 at the lower edge of the bottom row. NaN and infinity count as 0.
        top_down: whether v is 0 at the upper edge of the top row, as in glTF.
        wrap: wrap modes outside [0, 1] along u and v: repeat, mirror, or clamp to the last texel.
    """
    uv = np.where(np.isfinite(uv), uv, 0.0)
    u, v = (_within(uv[:, k], wrap[k]) for k in range(2))
    height, width = picture.shape[:2]
    down = v if top_down else 1.0 - v
    column = np.minimum((u * width).astype(np.int64), width - 1)
    return picture[np.minimum((down * height).astype(np.int64), height - 1), column]


def bounded_places(uv: Float[np.ndarray, "N 2"]) -> Float32[np.ndarray, "N 2"]:
    """Return texture coordinates in float32: 0 where they are not finite, cut where they repeat a million times."""
    return np.clip(np.nan_to_num(uv, nan=0.0, posinf=0.0, neginf=0.0), -1e6, 1e6).astype(np.float32)


def sample_bilinear(
    picture: UInt8[np.ndarray, "H W 3"], uv: Float[np.ndarray, "N 2"], *, wrap: tuple[str, str] = (REPEAT, REPEAT)
) -> UInt8[np.ndarray, "N 3"]:
    """Return the colour between the four nearest texels, blended as sRGB; v is 0 at the upper edge.

    Args:
        picture: texture, rows from the top, texel centres at +0.5.
        uv: texture coordinates.
        wrap: as in `sample_texture`; across the edges of a repeated texture the last texels are not blended.
    """
    height, width = picture.shape[:2]
    uv = np.where(np.isfinite(uv), uv, 0.0)
    # In 1/256 of a texel, so that whole numbers blend the bytes.
    x = np.clip(_within(uv[:, 0], wrap[0]) * width - 0.5, 0.0, width - 1.0)
    y = np.clip(_within(uv[:, 1], wrap[1]) * height - 0.5, 0.0, height - 1.0)
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    du, dv = (np.rint(256 * part).astype(np.uint32)[:, None] for part in (x - column, y - row))
    texels = picture.reshape(-1, 3)
    above = texels[row * width + column] * (256 - du) + texels[row * width + right] * du
    under = texels[below * width + column] * (256 - du) + texels[below * width + right] * du
    return ((above * (256 - dv) + under * dv + 32768) >> 16).astype(np.uint8)


def _within(x: Float[np.ndarray, " N"], wrap: str) -> Float[np.ndarray, " N"]:
    """Wrap coordinates into [0, 1]; those inside stay, including 1."""
    if wrap == CLAMP:
        return np.clip(x, 0.0, 1.0)
    inside = (x >= 0) & (x <= 1)
    if wrap == MIRROR:
        return np.where(inside, x, 1.0 - np.abs(x % 2.0 - 1.0))
    return np.where(inside, x, x % 1.0)


def average_corner_colors(
    vertices: Int64[np.ndarray, " C"], colors: UInt8[np.ndarray, "C 3"]
) -> tuple[Int64[np.ndarray, " n"], UInt8[np.ndarray, "n 3"]]:
    """Return the vertices that occur, and the mean colour of the corners of each.

    A vertex on a seam of the texture has several texture coordinates, whose colours may differ.
    """
    found, place = np.unique(vertices, return_inverse=True)
    corners = np.bincount(place, minlength=len(found))
    sums = np.stack([np.bincount(place, colors[:, k], minlength=len(found)) for k in range(3)], axis=1)
    return found, np.rint(sums / corners[:, None]).astype(np.uint8)
