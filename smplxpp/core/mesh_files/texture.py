"""Pictures that mesh files name: found inside the file's folder, decoded within bounds, sampled at the vertices."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import open_image
from smplxpp.core.files.paths import path_inside, regular_file
from smplxpp.core.mesh_files.raw_mesh import warn

if TYPE_CHECKING:
    from PIL.Image import Image

# The colour of a vertex that has none in a file of which others have.
LOST = 128
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
    picture: UInt8[np.ndarray, "H W 3"], uv: Float[np.ndarray, "N 2"], *, top_down: bool = False
) -> UInt8[np.ndarray, "N 3"]:
    """The colours of the texels that hold the coordinates, which repeat outside [0, 1].

    Args:
        picture: rows from the top.
        uv: texture coordinates; v is 0 at the bottom row's lower edge. NaN and infinity count as 0.
        top_down: v is 0 at the top row's upper edge, as in glTF.
    """
    uv = np.where(np.isfinite(uv), uv, 0.0)
    uv = np.where((uv >= 0) & (uv <= 1), uv, uv % 1.0)
    height, width = picture.shape[:2]
    down = uv[:, 1] if top_down else 1.0 - uv[:, 1]
    column = np.minimum((uv[:, 0] * width).astype(np.int64), width - 1)
    return picture[np.minimum((down * height).astype(np.int64), height - 1), column]
