"""Pictures that mesh files name: found inside the file's folder, decoded within bounds, sampled at the vertices."""

from __future__ import annotations

import io
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float, UInt8

from smplxpp.core.raw_mesh import warn

# The colour of a vertex that has none in a file of which others have.
LOST = 128
MOST_PIXELS = 1 << 28


def beside(path: Path, name: str) -> Path | None:
    """The file that a mesh file names: inside the mesh file's folder, or None.

    Names as Windows writes them are understood. One that leads out of the folder, as of another machine's disk, is
    looked for beside the mesh file under its last part; nothing outside the folder is ever opened.
    """
    parts = PurePosixPath(name.replace("\\", "/").strip('"'))
    folder = path.parent
    for candidate in (parts, PurePosixPath(parts.name)):
        try:
            found = (folder / candidate).resolve()
            if found.is_relative_to(folder.resolve()) and found.is_file():
                return found
        except (OSError, ValueError, RuntimeError):  # a NUL, too long a name, a loop of links
            continue
    return None


def read_picture(path: Path, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
    """The picture that a mesh file names; None, with a warning, where it is missing or cannot be used."""
    found = beside(path, name)
    if found is None:
        warn(f"mesh file {path}: its colours are lost: the picture {name!r} is not in its folder")
        return None
    return decode_picture(found.read_bytes(), subject=f"mesh file {path}", name=name)


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


def decode_picture(data: bytes, *, subject: str, name: str) -> UInt8[np.ndarray, "H W 3"] | None:
    """The picture in a file's bytes; None, with a warning, where it cannot be decoded or is too large."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.width * image.height > MOST_PIXELS:
                warn(f"{subject}: its colours are lost: the picture {name!r} has {image.width} x {image.height} pixels")
                return None
            return np.array(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        warn(f"{subject}: its colours are lost: the picture {name!r} cannot be read ({error})")
        return None
