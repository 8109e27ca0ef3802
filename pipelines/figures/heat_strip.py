"""A table of numbers as colours: a row a thing, a column a moment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from pipelines.figures.colors import heat_colors
from pipelines.figures.sheets import INK, WHITE, color_bar

_ROW, _TEXT = 18, 14
_WIDTH = 720


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
    cell = max(1, _WIDTH // count)
    colors = heat_colors(np.asarray(values, dtype=np.float64).ravel(), cmap=cmap, limits=limits)
    cells = colors.reshape(len(rows), count, 3).repeat(_ROW, axis=0).repeat(cell, axis=1)
    left = round(max(font.getlength(name) for name in rows)) + 10
    whole = Image.new("RGB", (left + cells.shape[1] + 24, cells.shape[0] + _ROW + 8), WHITE)
    whole.paste(Image.fromarray(cells), (left, 0))
    draw = ImageDraw.Draw(whole)
    for k, name in enumerate(rows):
        draw.text((left - 6, (k + 0.5) * _ROW), name, fill=INK, font=font, anchor="rm")
    apart = max(1, -(-count * 40 // _WIDTH))
    for k in range(0, count, apart):
        draw.text((left + (k + 0.5) * cell, cells.shape[0] + 4), str(columns[k]), fill=INK, font=font, anchor="mt")
    picture = np.asarray(whole)
    return np.concatenate([picture, color_bar(cmap=cmap, limits=limits, unit=unit, height=len(picture))], axis=1)
