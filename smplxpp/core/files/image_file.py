"""The one door for image files: photographs, masks, maps, textures."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import regular_file

if TYPE_CHECKING:
    from PIL.Image import Image

# Formats of pixels alone: Pillow also knows ones that start other programs (PostScript).
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM", "TGA", "GIF")
# Twice what Pillow warns of; the largest cameras have 150 million.
_MOST_PIXELS = 178_956_970


def open_image(path: str | Path, *, subject: str = "image file", remedy: str = "") -> Image:
    """An image, decoded; `info["raw_mode"]` says how the file stores its pixels.

    Raises:
        InputError: missing, no regular file, no whole image of a known format, or too many pixels.
    """
    return _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=True)


def decode_image(data: bytes, *, subject: str, remedy: str = "") -> Image:
    """An image in a file's bytes, decoded, as pictures inside of other files are; raises what `open_image` raises."""
    return _open(io.BytesIO(data), subject, remedy, decode=True)


def image_size(path: str | Path, *, subject: str = "image file", remedy: str = "") -> tuple[int, int]:
    """Width and height of an image, from the file's header.

    Raises:
        InputError: missing, no regular file, no image of a known format, or too many pixels.
    """
    return _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=False).size


def image_mode(path: str | Path, *, subject: str = "image file", remedy: str = "") -> str:
    """Pillow's name of the channels (such as RGBA), from the file's header; raises what `image_size` raises."""
    return _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=False).mode


def _open(source: Path | io.BytesIO, subject: str, remedy: str, *, decode: bool) -> Image:
    import PIL.Image

    try:
        with PIL.Image.open(source, formats=_FORMATS) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels, more than {_MOST_PIXELS}")
            image.info["raw_mode"] = str(image.tile[0][3]) if image.tile else ""
            if decode:
                image.load()
            return image
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  a decoder may raise anything on a broken file
        received = str(error)[:300] or type(error).__name__
        subject = f"{subject} {source}" if isinstance(source, Path) else subject
        raise InputError(subject, expected="a whole image", received=received, remedy=remedy) from None
