"""Compress the pictures of a report until its page is small enough to be mailed."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

from pipelines.report.model import Picture
from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import decode_image
from smplxpp.native import map_in_threads

PAGE_BYTES = 4_000_000
"""Largest size of a page, bytes. Mail servers refuse messages from 10 MB on, and base64 adds a third to a file."""
_LEVELS = ((88, 1600), (80, 1280), (70, 1024), (58, 800), (45, 640), (30, 480))
"""Quality of WebP, and the largest side in pixels, from the best on: a page is shown at most 1,200 pixels wide."""
_SIGNATURES = ((b"\x89PNG", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"RIFF", "image/webp"))


@dataclass(frozen=True)
class Embedded:
    """A picture as the page holds it: a data URI, and the size at which it is shown, CSS pixels."""

    uri: str
    width: int
    height: int


def embed_pictures(pictures: Iterable[Picture], *, room: int) -> dict[Picture, Embedded]:
    """Encode pictures so that their data URIs together take at most `room` bytes, as far as the lowest quality allows.

    Each keeps its own file where that is smaller than WebP of the same quality.

    Example:
        >>> import io
        >>> from PIL import Image
        >>> file = io.BytesIO()
        >>> Image.new("RGB", (300, 200)).save(file, "PNG")
        >>> picture = Picture("black", file.getvalue())
        >>> embedded = embed_pictures([picture], room=1000)[picture]
        >>> embedded.width, embedded.height, len(embedded.uri) < 1000
        (300, 200, True)

    Raises:
        InputError: bytes that are no PNG, JPEG or WebP.
    """
    shown = list(dict.fromkeys(pictures))
    out: dict[Picture, Embedded] = {}
    # One level serves all pictures, so that two that are compared with each other lose the same.
    for quality, side in _LEVELS:
        out = dict(zip(shown, map_in_threads(partial(_embedded, quality=quality, side=side), shown), strict=True))
        if sum(len(one.uri) for one in out.values()) <= room:
            break
    return out


def _embedded(picture: Picture, quality: int, side: int) -> Embedded:
    mime = next((kind for start, kind in _SIGNATURES if picture.data.startswith(start)), None)
    if mime is None:
        raise InputError(f"picture {picture.caption!r}", expected="PNG, JPEG or WebP", received=repr(picture.data[:4]))
    data = picture.data
    image = decode_image(data, subject=f"picture {picture.caption!r}").convert("RGB")
    width, height = image.size
    large = max(image.size) > side
    # A photograph that is JPEG already is not encoded again at the best level, because that adds errors of its own.
    if mime == "image/png" or large or quality < _LEVELS[0][0]:
        if large:
            image.thumbnail((side, side))
        file = io.BytesIO()
        # Enlarged pixels are squares with sharp edges, and every error of the encoding would be seen.
        image.save(file, "WEBP", quality=quality, method=4, lossless=picture.enlarged > 1)
        if file.tell() < len(data):
            data, mime = file.getvalue(), "image/webp"
    uri = f"data:{mime};base64,{base64.b64encode(data).decode()}"
    return Embedded(uri, width * picture.enlarged, height * picture.enlarged)
