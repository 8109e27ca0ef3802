"""Read a user's own label set, the content of a labels.yaml: classes with names, ids, colours, layers and rules."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from smplxpp.core import BACKGROUND, LABEL_BY_NAME, LABELS, InputError, require_choice, require_known
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text
from smplxpp.core.labels import Label, Labels, color
from smplxpp.segment.label_sets import LABEL_SETS, LabelSet

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
