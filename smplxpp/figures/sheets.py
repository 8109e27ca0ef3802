"""Rows and contact sheets with captions, colour bars, and pictures as bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from smplxpp.core.errors import InputError
from smplxpp.figures.colors import colormap, heat_colors

INK = (38, 42, 51)
WHITE = (255, 255, 255)


def encode_png(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """Encode a picture as PNG, without loss."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "PNG", optimize=False, compress_level=6)
    return buffer.getvalue()


def encode_jpeg(image: UInt8[np.ndarray, "H W 3"], *, quality: int = 88) -> bytes:
    """Encode a picture as JPEG with full colour resolution: about a fifth of the PNG for shaded scans."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "JPEG", quality=quality, subsampling=0, optimize=True)
    return buffer.getvalue()


def caption(
    image: UInt8[np.ndarray, "H W 3"], text: str, *, size: int = 20, background: tuple[int, int, int] = WHITE
) -> UInt8[np.ndarray, "H2 W 3"]:
    """Put a line of text under a picture."""
    strip = Image.new("RGB", (image.shape[1], round(1.9 * size)), background)
    ImageDraw.Draw(strip).text(
        (strip.width / 2, strip.height / 2), text, fill=INK, font=ImageFont.load_default(size), anchor="mm"
    )
    return np.concatenate([image, np.asarray(strip)], axis=0)


def row(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]], *, gap: int = 12, background: tuple[int, int, int] = WHITE
) -> UInt8[np.ndarray, "H W 3"]:
    """Put pictures side by side, their upper edges aligned."""
    if not images:
        raise InputError("pictures of a row", expected="at least one", received="none")
    height = max(len(image) for image in images)
    width = sum(image.shape[1] for image in images) + gap * (len(images) - 1)
    out = np.empty((height, width, 3), np.uint8)
    out[:] = background
    left = 0
    for image in images:
        out[: len(image), left : left + image.shape[1]] = image
        left += image.shape[1] + gap
    return out


def contact_sheet(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    *,
    captions: Sequence[str] = (),
    columns: int = 4,
    gap: int = 12,
    background: tuple[int, int, int] = WHITE,
) -> UInt8[np.ndarray, "H W 3"]:
    """Put pictures in a grid of `columns`, each centred in a cell of the largest picture's size."""
    if captions and len(captions) != len(images):
        raise InputError("captions", expected=f"one a picture ({len(images)})", received=str(len(captions)))
    cells = list(images)
    if captions:
        cells = [caption(image, text, background=background) for image, text in zip(images, captions, strict=True)]
    if not cells:
        raise InputError("pictures of a sheet", expected="at least one", received="none")
    # All cells have the size of the largest picture; the number of rows is rounded up.
    height, width = max(len(c) for c in cells), max(c.shape[1] for c in cells)
    columns = min(columns, len(cells))
    rows = -(-len(cells) // columns)
    out = np.empty((rows * height + gap * (rows - 1), columns * width + gap * (columns - 1), 3), np.uint8)
    out[:] = background
    for k, cell in enumerate(cells):
        top = (k // columns) * (height + gap)
        left = (k % columns) * (width + gap) + (width - cell.shape[1]) // 2
        out[top : top + len(cell), left : left + cell.shape[1]] = cell
    return out


def color_bar(
    *,
    cmap: str,
    limits: tuple[float, float],
    unit: str,
    height: int,
    background: tuple[int, int, int] = WHITE,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a vertical colour bar of a height in pixels, with five labelled ticks."""
    low, high = limits
    values = np.linspace(low, high, 5)
    size = max(14, height // 36)  # still readable when the picture is shown at half its size
    font = ImageFont.load_default(size)
    labels = [f"{value:.4g}" for value in values]
    labels[-1] = f"{labels[-1]} {unit}".strip()
    length = max(2, min(round(0.5 * height), 20 * size))
    top, bar = (height - length) // 2, size
    text_width = max(font.getlength(label) for label in labels)
    strip = Image.new("RGB", (int(bar + 22 + text_width), height), background)
    ramp = colormap(cmap)[np.linspace(255, 0, length).round().astype(int)]
    strip.paste(Image.fromarray(np.ascontiguousarray(np.repeat(ramp[:, None], bar, axis=1))), (4, top))
    draw = ImageDraw.Draw(strip)
    for k, label in enumerate(labels):
        y = top + (length - 1) * (1.0 - k / (len(labels) - 1))
        draw.line([(4 + bar, y), (9 + bar, y)], fill=INK, width=1)
        draw.text((13 + bar, y), label, fill=INK, font=font, anchor="lm")
    return np.asarray(strip)


_ROW, _TEXT = 18, 14


def heat_strip(
    values: Float[np.ndarray, "R C"],
    rows: Sequence[str],
    columns: Sequence[int],
    *,
    limits: tuple[float, float],
    cmap: str = "weight",
    unit: str = "",
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw values as coloured cells with the rows' names before them and some columns' numbers below.

    Values outside `limits` take the end colours, values that are not finite are grey.
    """
    font = ImageFont.load_default(_TEXT)
    count = len(columns)
    width = 720
    # A cell is a whole number of pixels wide, so that columns do not blur into each other.
    cell = max(1, width // count)
    colors = heat_colors(np.asarray(values, dtype=np.float64).ravel(), cmap=cmap, limits=limits)
    cells = colors.reshape(len(rows), count, 3).repeat(_ROW, axis=0).repeat(cell, axis=1)
    left = round(max(font.getlength(name) for name in rows)) + 10
    whole = Image.new("RGB", (left + cells.shape[1] + 24, cells.shape[0] + _ROW + 8), WHITE)
    whole.paste(Image.fromarray(cells), (left, 0))
    draw = ImageDraw.Draw(whole)
    for k, name in enumerate(rows):
        draw.text((left - 6, (k + 0.5) * _ROW), name, fill=INK, font=font, anchor="rm")
    # A number takes about 40 pixels: label every n-th column, so that numbers do not overlap.
    apart = max(1, -(-count * 40 // width))
    for k in range(0, count, apart):
        draw.text((left + (k + 0.5) * cell, cells.shape[0] + 4), str(columns[k]), fill=INK, font=font, anchor="mt")
    picture = np.asarray(whole)
    return np.concatenate([picture, color_bar(cmap=cmap, limits=limits, unit=unit, height=len(picture))], axis=1)
