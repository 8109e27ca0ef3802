"""Open image files (photographs, masks, maps, textures) in safe formats and bounded sizes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import regular_file

if TYPE_CHECKING:
    from PIL.Image import Image

# Raster formats only: Pillow also opens formats that start other programs (PostScript).
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM", "TGA", "GIF")


def open_image(path: str | Path, *, subject: str = "image file", remedy: str = "") -> Image:
    """Open and decode an image, its pixels as stored.

    `info["raw_mode"]` tells how the file stores its pixels, `info["orientation"]` its EXIF orientation (1 to 8).

    Raises:
        InputError: missing, no regular file, no whole image of a known format, or too many pixels.
    """
    return _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=True)


def decode_image(data: bytes, *, subject: str, remedy: str = "") -> Image:
    """Decode an image from bytes, such as one embedded in another file; raises what `open_image` raises."""
    return _open(io.BytesIO(data), subject, remedy, decode=True)


def image_size(path: str | Path, *, subject: str = "image file", remedy: str = "") -> tuple[int, int]:
    """Return width and height of an image, from the file's header.

    Raises:
        InputError: missing, no regular file, no image of a known format, or too many pixels.
    """
    return _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=False).size


def image_mode(path: str | Path, *, subject: str = "image file", remedy: str = "") -> str:
    """Return Pillow's mode of an image (such as RGBA), from the file's header; raises what `image_size` raises."""
    return _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=False).mode


def image_orientation(path: str | Path, *, subject: str = "image file", remedy: str = "") -> int:
    """Return the EXIF orientation that an image states, 1 (as stored) to 8; 1 without one.

    Raises what `image_size` raises.
    """
    image = _open(regular_file(path, subject=subject, remedy=remedy), subject, remedy, decode=False)
    return int(image.info["orientation"])


def _open(source: Path | io.BytesIO, subject: str, remedy: str, *, decode: bool) -> Image:
    import PIL.Image

    # Twice the number that Pillow warns of; the largest cameras have 150 million pixels.
    max_pixels = 178_956_970
    try:
        with PIL.Image.open(source, formats=_FORMATS) as image:
            if image.width * image.height > max_pixels:
                raise ValueError(f"{image.width} x {image.height} pixels, more than {max_pixels}")
            image.info["raw_mode"] = str(image.tile[0][3]) if image.tile else ""
            image.info["orientation"] = _orientation(image)
            if decode:
                image.load()
            return image
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  a decoder may raise anything on a broken file
        received = str(error)[:300] or type(error).__name__
        subject = f"{subject} {source}" if isinstance(source, Path) else subject
        raise InputError(subject, expected="a whole image", received=received, remedy=remedy) from None


def _orientation(image: Image) -> int:
    """Return tag 0x0112 of an image's EXIF data; 1 where there is none, or none that is defined."""
    try:
        stated = image.getexif().get(0x0112, 1)
    except Exception:  # noqa: BLE001  broken EXIF data do not make the pixels unreadable
        return 1
    return stated if isinstance(stated, int) and 1 <= stated <= 8 else 1
