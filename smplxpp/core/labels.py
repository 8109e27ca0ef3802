"""Define the semantic labels of a clothed person: the classes of 4D-Dress, and things that are carried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Integer, UInt8


@dataclass(frozen=True)
class Label:
    """A semantic class of the surface of a clothed person.

    Attributes:
        id: number of the class in 4D-Dress; `object` follows its classes.
        name: name of the class in this project.
        display_rgb: colour in pictures, that of 4D-Dress.
        semantic_rgb: colour in the label maps that a training reads (TaoAvatar: hair yellow, clothes red).
        face_budget: number of faces that simplification keeps of a part with this label (TaoAvatar).
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
OBJECT = Label(6, "object", (240, 200, 0), (0, 128, 255), 4_000)
"""A thing that a person holds or carries, such as a bag: rigid, bound to one joint, and no layer of clothes."""

LABELS: tuple[Label, ...] = (SKIN, HAIR, SHOE, UPPER, LOWER, OUTER, OBJECT)
BACKGROUND = -1
"""Label id of pixels and faces that show no part of the person."""
CLOTH_LABELS: tuple[Label, ...] = (UPPER, LOWER, OUTER)
LAYER_ORDER: tuple[int, ...] = (SHOE.id, LOWER.id, UPPER.id, OUTER.id, HAIR.id)
"""Label ids from the innermost to the outermost layer: shoes, trousers, shirt, coat, hair."""
LABEL_BY_NAME: dict[str, Label] = {label.name: label for label in LABELS}


def display_colors(
    label_ids: Integer[np.ndarray, "*N"], certain: Bool[np.ndarray, "*N"] | None = None
) -> UInt8[np.ndarray, "*N 3"]:
    """Return the display colours of label ids, pale where a label is uncertain; the background is black."""
    table = np.array([label.display_rgb for label in LABELS] + [(0, 0, 0)], dtype=np.uint8)
    colors = table[np.asarray(label_ids)]
    if certain is None:
        return colors
    # A third of the colour and two of white: still to be told apart.
    return np.where(np.asarray(certain)[..., None], colors, 170 + colors // 3).astype(np.uint8)


def semantic_colors(label_ids: Integer[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N 3"]:
    """Return the semantic colours of label ids; the background is black."""
    table = np.array([label.semantic_rgb for label in LABELS] + [(0, 0, 0)], dtype=np.uint8)
    return table[np.asarray(label_ids)]
