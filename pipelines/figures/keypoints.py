"""Keypoints on the photographs in which they were found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

LEFT, RIGHT, MIDDLE = (52, 130, 246), (232, 64, 52), (250, 205, 50)
"""Colours of the person's own left and right, and of what is on neither side."""
_FINE = 3  # drawn this many times larger and shrunk: smooth discs
_RADIUS, _SMALL = 1 / 160, 1 / 400  # of the picture's longer side; points of hands and face are small


def draw_keypoints(
    picture: UInt8[np.ndarray, "H W 3"],
    names: Sequence[str],
    points: Float[np.ndarray, "K 2"],
    confidence: Float[np.ndarray, " K"],
    *,
    least: float = 0.3,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw points with a confidence of at least `least` as discs, the fainter the less sure they are."""
    height, width = picture.shape[:2]
    size = (_FINE * width, _FINE * height)
    whole = Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR).convert("RGBA")
    layer = Image.new("RGBA", size)
    draw = ImageDraw.Draw(layer)
    for name, (x, y), sure in zip(names, _FINE * np.asarray(points), confidence, strict=True):
        if sure < least:
            continue
        color = LEFT if "left_" in name else RIGHT if "right_" in name else MIDDLE
        share = _SMALL if name[-1].isdigit() or name.endswith("_tip") else _RADIUS
        radius = share * max(size)
        box = [x - radius, y - radius, x + radius, y + radius]
        draw.ellipse(box, fill=(*color, round(80 + 175 * min(float(sure), 1.0))))
    drawn = Image.alpha_composite(whole, layer).convert("RGB")
    return np.asarray(drawn.resize((width, height), Image.Resampling.BOX))
