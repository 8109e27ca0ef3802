"""Map label sets of other data sets and parsers onto ours.

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
from pathlib import Path

import numpy as np
from jaxtyping import Int64, Num

from smplxpp.core import BACKGROUND, LABEL_BY_NAME, LABELS, InputError
from smplxpp.core.files.json_file import read_json

_OURS = {name: label.id for name, label in LABEL_BY_NAME.items()} | {"background": BACKGROUND}


@dataclass(frozen=True)
class LabelSet:
    """The numbering of semantic classes in one data set or parser.

    Attributes:
        name: name in options and messages.
        classes: (their id, their name, our name) of every class.
    """

    name: str
    classes: tuple[tuple[int, str, str], ...]

    @property
    def ours(self) -> dict[int, int]:
        """Return the mapping from their ids to ours."""
        return {number: _OURS[ours] for number, _, ours in self.classes}


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


def find_label_set(name: str | Path | LabelSet) -> LabelSet:
    """Return a label set by its name, or from a JSON file `{"<their id>": "<our name>", ...}`.

    Our names: skin, hair, shoe, upper, lower, outer, object, background.

    Raises:
        InputError: an unknown name, or a file that is not such a mapping.
    """
    if isinstance(name, LabelSet):
        return name
    if str(name) in LABEL_SETS:
        return LABEL_SETS[str(name)]
    path = Path(name)
    if path.suffix.lower() != ".json" or not path.is_file():
        raise InputError(
            "label set", expected=f"one of {', '.join(LABEL_SETS)}, or an existing JSON file", received=repr(str(name))
        )
    expected = f"a mapping of integers to names among {', '.join(_OURS)}"
    try:
        mapping = read_json(path)
        classes = tuple(sorted((int(number), str(ours), ours) for number, ours in mapping.items()))
    except (ValueError, AttributeError) as error:
        raise InputError(f"label set {path}", expected=expected, received=str(error)) from None
    unknown = sorted({str(ours) for _, _, ours in classes if not isinstance(ours, str) or ours not in _OURS})
    if unknown or not classes:
        raise InputError(f"label set {path}", expected=expected, received=f"{', '.join(unknown) or 'nothing'}")
    return LabelSet(path.stem, classes)


def map_labels(
    ids: Num[np.ndarray, "*N"], label_set: str | Path | LabelSet | Mapping[int, int]
) -> Int64[np.ndarray, "*N"]:
    """Map ids of a label set, in an array of any shape, to ours (int64, background -1).

    Args:
        ids: integers; floats that hold integers are accepted.
        label_set: see `find_label_set`; or a mapping from their ids to ours.

    Raises:
        InputError: ids that the set does not have.
    """
    name = "mapping" if isinstance(label_set, Mapping) else find_label_set(label_set).name
    mapping = label_set if isinstance(label_set, Mapping) else find_label_set(label_set).ours
    ids = np.asarray(ids)
    whole = ids.dtype.kind == "f" and np.array_equal(ids, np.rint(ids)) and (np.abs(ids) < 2**53).all()
    if ids.dtype.kind not in "iub" and not whole:
        raise InputError("label ids", expected="integers", received=str(ids.dtype))
    unique, inverse = np.unique(ids.astype(np.int64), return_inverse=True)
    unknown = [int(u) for u in unique if int(u) not in mapping]
    if unknown:
        raise InputError(
            f"label ids of set {name!r}",
            expected=f"ids among {sorted(mapping)}",
            received=f"{unknown[:10]}{' ...' if len(unknown) > 10 else ''}",
            remedy="name the label set that the file uses, or give a JSON mapping",
        )
    return np.array([mapping[int(u)] for u in unique], dtype=np.int64)[inverse].reshape(ids.shape)
