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

import colorsys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int64

from smplxpp.core import BACKGROUND, LABEL_BY_NAME, LABELS, InputError, Label, Labels, require_choice, require_known
from smplxpp.core.errors import one_line
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text
from smplxpp.core.labels import color


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
        return label_set_of(content, subject="label set")

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

_ENTRIES = ("name", "ids", "kind", "color", "layer", "faces", "fit", "rule")
_OF_SET = ("name", "files", "classes")
_LIKE = {
    **{theirs: ours for one in LABEL_SETS.values() for _, theirs, ours in one.classes if ours in LABEL_BY_NAME},
    **{"glasses": "object", "sock": "shoe", "shoes": "shoe", "boots": "shoe", "cap": "hair", "helmet": "hair"},
    **{"shirt": "upper", "jumpsuit": "upper", "trousers": "lower", "leggings": "lower", "jacket": "outer"},
    **{"cape": "outer", "backpack": "object"},
}
"""The built-in class that a class of this name behaves like, unless its entry says."""
_APART = 25.0
"""Least distance in 8-bit RGB between two colours, which meshes in colours of labels are read by (within 24)."""


def label_set_of(content: Mapping[str, Any], *, subject: str, name: str = "own") -> LabelSet:
    """Return the set that a labels.yaml describes.

    Args:
        content: `{"files": SET, "classes": [{"name": ..., "ids": ..., ...}, ...]}`, see docs/labels.md.
        subject: what the content is called in messages.
        name: of the set, unless the content has one.

    Raises:
        InputError: it names the class and the entry.
    """
    require_known(f"{subject}: entries", content, _OF_SET)
    base = None
    if content.get("files") is not None:
        require_choice(f"{subject}: files", str(content["files"]), tuple(LABEL_SETS))
        base = LABEL_SETS[str(content["files"])]
    rows = [as_object(row, subject=f"{subject}: a class") for row in as_list(content.get("classes"), subject=subject)]
    labels, names = list(LABELS), []
    numbers: dict[int, str] = {}
    for k, row in enumerate(rows):
        title = as_text(row.get("name"), subject=f"{subject}: name of class {k + 1}")
        where = f"{subject}: class {title!r}"
        require_known(f"{where}: entries", row, _ENTRIES)
        if title in names:
            raise InputError(where, expected="one class of this name", received="several")
        names.append(title)
        # The built-in labels come first and are changed in place; a user's own follow.
        if title in LABEL_BY_NAME:
            label = _changed(LABEL_BY_NAME[title], row, where)
            labels[label.id] = label
        elif title != "background":
            labels.append(_own(title, len(labels), row, where))
        for number in _numbers(row.get("ids"), title, base, where):
            if number in numbers:
                raise InputError(f"{where}: ids", expected="each id once", received=f"{number}, of {numbers[number]!r}")
            numbers[number] = title
    if not names:
        raise InputError(f"{subject}: classes", expected="at least one", received="none")
    # Classes of the files' own set that no class here has stay what they are in it.
    theirs = {} if base is None else {number: (called, ours) for number, called, ours in base.classes}
    classes = {number: (theirs.get(number, (title, ""))[0], title) for number, title in numbers.items()}
    classes = {**theirs, **classes}
    if base is None:
        classes.setdefault(BACKGROUND, ("background", "background"))
    made = Labels(tuple(labels))
    _require_apart(made, subject)
    return LabelSet(
        as_text(content.get("name", name), subject=f"{subject}: name"),
        tuple((number, called, ours) for number, (called, ours) in sorted(classes.items())),
        made,
    )


def _own(title: str, number: int, row: Mapping[str, Any], where: str) -> Label:
    """Return a user's own label, which takes what its entry does not say from the class that it behaves like."""
    like = row.get("kind", _LIKE.get(title))
    if like is None:
        raise InputError(
            f"{where}: kind",
            expected=f"the class that it behaves like, one of {', '.join(LABELS.names)}",
            received="none",
            remedy="as no built-in set has a class of this name",
        )
    require_choice(f"{where}: kind", str(like), LABELS.names)
    # Hues a golden section apart: distinct for any number of classes.
    hue = (0.13 + 0.618034 * (number - len(LABELS))) % 1.0
    red, green, blue = (round(255 * one) for one in colorsys.hsv_to_rgb(hue, 0.55, 0.95))
    label = replace(LABEL_BY_NAME[str(like)], id=number, name=title, display_rgb=(red, green, blue))
    return _changed(label, row, where)


def _changed(label: Label, row: Mapping[str, Any], where: str) -> Label:
    """Return a label with the entries of a class."""
    given: dict[str, Any] = {}
    if "color" in row:
        given["display_rgb"] = color(row["color"], subject=f"{where}: color")
    if "layer" in row:
        given["layer"] = as_number(row["layer"], subject=f"{where}: layer", least=-100.0, most=100.0)
    if "faces" in row:
        given["face_budget"] = as_integer(row["faces"], subject=f"{where}: faces", least=100, most=10_000_000)
    if "fit" in row:
        require_choice(f"{where}: fit", str(row["fit"]), ("loose", "tight"))
        given["tight"] = row["fit"] == "tight"
    if "rule" in row:
        given["rule"] = as_text(row["rule"], subject=f"{where}: rule")
    if row.get("kind", label.kind) != label.kind:
        raise InputError(f"{where}: kind", expected=f"{label.kind}, as it is built in", received=repr(row["kind"]))
    return replace(label, **given)


def _numbers(value: Any, title: str, base: LabelSet | None, where: str) -> list[int]:
    """Return the ids of a class in files: numbers, or names of the files' set; without any, its own name there."""
    by_name: dict[str, list[int]] = {}
    for number, called, _ in () if base is None else base.classes:
        # "sock" means both "left sock" and "right sock".
        for name in {called, called.removeprefix("left ").removeprefix("right ")}:
            by_name.setdefault(name, []).append(number)
    if value is None:
        return by_name.get(title, [])
    out: list[int] = []
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, str):
            require_choice(f"{where}: ids", one, tuple(by_name))
            out += by_name[one]
            continue
        number = as_integer(one, subject=f"{where}: ids", least=-1, most=2**31)
        if base is not None:
            require_known(f"{where}: ids of {base.name}", [number], base.ours)
        out.append(number)
    return out


def _require_apart(labels: Labels, subject: str) -> None:
    table = np.array([label.display_rgb for label in labels], dtype=np.float64)
    distance = np.linalg.norm(table[:, None] - table, axis=2) + np.diag(np.full(len(labels), np.inf))
    a, b = np.unravel_index(distance.argmin(), distance.shape)
    if distance[a, b] < _APART:
        raise InputError(
            f"{subject}: color",
            expected="colours that can be told apart",
            received=f"{labels[int(a)].name} {labels[int(a)].display_rgb} and {labels[int(b)].name} "
            f"{labels[int(b)].display_rgb}",
        )
