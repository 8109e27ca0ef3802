"""The semantic labels of a clothed person: 4D-Dress's classes, with our names and colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Integer, UInt8


@dataclass(frozen=True)
class Label:
    """A semantic class.

    Attributes:
        id: 4D-Dress's number.
        name: ours.
        display_rgb: 4D-Dress's colour, for pictures.
        semantic_rgb: the colour that the trainer sees (TaoAvatar: hair yellow, clothes red).
        face_budget: faces kept by default when a part of this label is simplified (TaoAvatar).
    """

    id: int
    name: str
    display_rgb: tuple[int, int, int]
    semantic_rgb: tuple[int, int, int]
    face_budget: int


SKIN = Label(0, "skin", (128, 128, 128), (128, 128, 128), 0)
HAIR = Label(1, "hair", (255, 128, 0), (255, 255, 0), 2_000)
SHOE = Label(2, "shoe", (128, 0, 255), (128, 0, 255), 2_000)
UPPER = Label(3, "upper", (180, 50, 50), (255, 0, 0), 20_000)
LOWER = Label(4, "lower", (50, 180, 50), (255, 0, 0), 20_000)
OUTER = Label(5, "outer", (0, 128, 255), (255, 0, 0), 20_000)

LABELS: tuple[Label, ...] = (SKIN, HAIR, SHOE, UPPER, LOWER, OUTER)
BACKGROUND = -1
CLOTH_LABELS: tuple[Label, ...] = (UPPER, LOWER, OUTER)
LAYER_ORDER: tuple[int, ...] = (SHOE.id, LOWER.id, UPPER.id, OUTER.id, HAIR.id)
"""From the skin outwards: a shirt hangs over trousers, trousers over shoes, hair over everything."""
LABEL_BY_NAME: dict[str, Label] = {label.name: label for label in LABELS}


def display_colors(label_ids: Integer[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N 3"]:
    """The display colours of label ids; background black."""
    table = np.array([label.display_rgb for label in LABELS] + [(0, 0, 0)], dtype=np.uint8)
    return table[np.asarray(label_ids)]


def semantic_colors(label_ids: Integer[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N 3"]:
    """The semantic colours of label ids; background black."""
    table = np.array([label.semantic_rgb for label in LABELS] + [(0, 0, 0)], dtype=np.uint8)
    return table[np.asarray(label_ids)]
