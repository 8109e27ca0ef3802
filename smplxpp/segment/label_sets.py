"""Hold the label sets of data sets and parsers: their numbers, their names, and which of our labels these are.

Some of their classes are finer than ours, or differ from them:

| theirs | ours | why |
|---|---|---|
| socks, shoes | shoe | worn over the foot, move with it |
| hat | hair | rigid on the head, as hair is |
| gloves, face, limbs, feet, hands, mouth | skin | lie on the body, which the body model represents |
| scarf, apparel | outer | worn over the upper clothes |
| coat | outer | |
| dress, jumpsuit | upper | one garment from the shoulders; it stays whole |
| pants, skirt, belt | lower | |
| bag, sunglasses | object | rigid, follow one joint |
| undefined background, ignored (255) | background | |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Int64

from smplxpp.core import BACKGROUND, LABELS
from smplxpp.core.errors import one_line
from smplxpp.core.labels import Labels


@dataclass(frozen=True)
class LabelSet:
    """The numbering of semantic classes in the files of a data set, a parser or a user, and the labels they stand for.

    Attributes:
        name: name in options and messages.
        classes: (their id, their name, our name) of every class.
        labels: the labels that our names are of.

    Example:
        >>> content = {"name": "mine", "files": "lip", "classes": [{"name": "hat", "rule": "rigid:head"}]}
        >>> smplxpp.LabelSet.of(content).labels.own[0].kind
        'hair'
    """

    name: str
    classes: tuple[tuple[int, str, str], ...]
    labels: Labels = LABELS

    __repr__ = one_line

    @staticmethod
    def of(content: Mapping[str, Any]) -> LabelSet:
        """Return the set that a `labels.yaml` of this content describes (docs/labels.md).

        Raises:
            InputError: it names the class and the entry.
        """
        # The reader of such files stands above the built-in sets, whose names it knows.
        return import_module("smplxpp.segment.label_set_file").label_set_of(dict(content), subject="label set")

    @property
    def ours(self) -> dict[int, int]:
        """Return the mapping from their ids to ours; what behaves like skin is skin."""
        known = {label.name: 0 if label.kind == "skin" else label.id for label in self.labels}
        known["background"] = BACKGROUND
        return {number: known[ours] for number, _, ours in self.classes}

    def of_body(self, label_ids: Int64[np.ndarray, "*N"]) -> Int64[np.ndarray, "*N"]:
        """Return the labels for built-in ones that body and colours told.

        A built-in label that files use stays; else the first of the user's own labels that behaves like it has it.
        """
        used = {ours for _, _, ours in self.classes}
        table = np.arange(len(LABELS) + 1)
        table[-1] = BACKGROUND
        for label in LABELS:
            alike = [own.id for own in self.labels.own if own.kind == label.name]
            if label.name not in used and alike and label.name != "skin":
                table[label.id] = alike[0]
        return table[np.asarray(label_ids)]


def _numbered(name: str, *classes: tuple[str, str]) -> LabelSet:
    return LabelSet(name, tuple((k, theirs, ours) for k, (theirs, ours) in enumerate(classes)))


def _parser(name: str, *classes: tuple[str, str]) -> LabelSet:
    """Return a parser's label set: classes from 0, and 255 for pixels to be ignored, which do not vote."""
    return LabelSet(name, (*_numbered(name, *classes).classes, (255, "ignored", "background")))


_LIP = (
    ("background", "background"),
    ("hat", "hair"),
    ("hair", "hair"),
    ("glove", "skin"),
    ("sunglasses", "object"),
    ("upper clothes", "upper"),
    ("dress", "upper"),
    ("coat", "outer"),
    ("socks", "shoe"),
    ("pants", "lower"),
    ("jumpsuits", "upper"),
    ("scarf", "outer"),
    ("skirt", "lower"),
    ("face", "skin"),
    ("left arm", "skin"),
    ("right arm", "skin"),
    ("left leg", "skin"),
    ("right leg", "skin"),
    ("left shoe", "shoe"),
    ("right shoe", "shoe"),
)
_SAPIENS_SIDE = (
    ("foot", "skin"),
    ("hand", "skin"),
    ("lower arm", "skin"),
    ("lower leg", "skin"),
    ("shoe", "shoe"),
    ("sock", "shoe"),
    ("upper arm", "skin"),
    ("upper leg", "skin"),
)

LABEL_SETS: dict[str, LabelSet] = {
    label_set.name: label_set
    for label_set in (
        LabelSet(
            "4ddress",
            ((BACKGROUND, "background", "background"), *((label.id, label.name, label.name) for label in LABELS)),
        ),
        _numbered(
            "capture",
            ("background", "background"),
            ("skin", "skin"),
            ("hair", "hair"),
            ("shoes", "shoe"),
            ("upper", "upper"),
            ("lower", "lower"),
            ("other body", "skin"),
        ),
        _parser("lip", *_LIP),
        _parser("cihp", *_LIP[:10], ("torso skin", "skin"), *_LIP[11:]),
        _parser(
            "atr",
            ("background", "background"),
            ("hat", "hair"),
            ("hair", "hair"),
            ("sunglasses", "object"),
            ("upper clothes", "upper"),
            ("skirt", "lower"),
            ("pants", "lower"),
            ("dress", "upper"),
            ("belt", "lower"),
            ("left shoe", "shoe"),
            ("right shoe", "shoe"),
            ("face", "skin"),
            ("left leg", "skin"),
            ("right leg", "skin"),
            ("left arm", "skin"),
            ("right arm", "skin"),
            ("bag", "object"),
            ("scarf", "outer"),
        ),
        # It tells limbs and no clothes: alone it names skin, with a user's own classes what they make of it.
        _parser(
            "pascal",
            ("background", "background"),
            ("head", "skin"),
            ("torso", "skin"),
            ("upper arms", "skin"),
            ("lower arms", "skin"),
            ("upper legs", "skin"),
            ("lower legs", "skin"),
        ),
        _parser(
            "sapiens",
            ("background", "background"),
            ("apparel", "outer"),
            ("face and neck", "skin"),
            ("hair", "hair"),
            *((f"left {theirs}", ours) for theirs, ours in _SAPIENS_SIDE),
            ("lower clothing", "lower"),
            *((f"right {theirs}", ours) for theirs, ours in _SAPIENS_SIDE),
            ("torso", "skin"),
            ("upper clothing", "upper"),
            ("lower lip", "skin"),
            ("upper lip", "skin"),
            ("lower teeth", "skin"),
            ("upper teeth", "skin"),
            ("tongue", "skin"),
        ),
    )
}
