"""Define the semantic labels of a clothed person: the classes of 4D-Dress, things that are carried, a user's own."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64, Integer, UInt8

from smplxpp.core.errors import InputError, one_line, require_choice
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text

_NAME = re.compile(r"\w[\w -]{0,60}")  # of parts, nodes and files
_RULES = ("auto", "isolate", "rigid", "chain")


@dataclass(frozen=True)
class PartRule:
    """How a part, or a connected component of one, follows the skeleton.

    Attributes:
        kind: "auto", the weights that the transfer finds; "rigid", one joint; "chain", the transfer from the skin of
            some joints alone; "isolate", each connected component rigid, by the joint of the body nearest to it.
        joints: names of the joint of "rigid", or of those of "chain".
    """

    kind: str = "auto"
    joints: tuple[str, ...] = ()

    @staticmethod
    def parse(text: str, *, subject: str = "rule") -> PartRule:
        """Read `auto`, `isolate`, `rigid:JOINT` or `chain:JOINT,JOINT,...`.

        Raises:
            InputError: anything else.

        Example:
            >>> from smplxpp.core.labels import PartRule
            >>> PartRule.parse("chain:left_shoulder,left_elbow").joints
            ('left_shoulder', 'left_elbow')
        """
        kind, _, rest = text.strip().partition(":")
        joints = tuple(name.strip() for name in rest.split(",") if name.strip())
        fits = {"rigid": len(joints) == 1, "chain": len(joints) >= 1}.get(kind, not joints)
        if kind not in _RULES or not fits:
            raise InputError(
                subject, expected="auto, isolate, rigid:JOINT or chain:JOINT,JOINT,...", received=repr(text)
            )
        return PartRule(kind, joints)


@dataclass(frozen=True)
class Label:
    """A semantic class of the surface of a clothed person.

    Attributes:
        id: its place among the `Labels`; the first seven are those of `LABELS`, numbered as in 4D-Dress.
        name: name of the class, and of its part.
        display_rgb: colour in pictures; of the built-in classes that of 4D-Dress.
        semantic_rgb: colour in the label maps that a training reads (TaoAvatar: hair yellow, clothes red).
        face_budget: number of faces that simplification keeps of a part with this label (TaoAvatar).
        kind: the built-in class that it behaves like, as what it is worn; "" for itself.
        layer: place from the skin outwards, in the numbers of the built-in classes (shoe 1, lower 2, upper 3, outer 4,
            hair 5); None for skin and for things, which are no layers.
        tight: it lies on the skin as socks and leggings do: it bends where the skin does, and is not simulated.
        rule: how its part follows the skeleton, see `PartRule`.
    """

    id: int
    name: str
    display_rgb: tuple[int, int, int]
    semantic_rgb: tuple[int, int, int]
    face_budget: int
    kind: str = ""
    layer: float | None = None
    tight: bool = False
    rule: str = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", self.kind or self.name)

    @property
    def stiff(self) -> bool:
        """Whether its part is rigid, as a whole or piece by piece."""
        return PartRule.parse(self.rule).kind in ("rigid", "isolate")


SKIN = Label(0, "skin", (128, 128, 128), (128, 128, 128), 0)
HAIR = Label(1, "hair", (255, 128, 0), (255, 255, 0), 2_000, layer=5)
SHOE = Label(2, "shoe", (128, 0, 255), (128, 0, 255), 2_000, layer=1)
UPPER = Label(3, "upper", (180, 50, 50), (255, 0, 0), 20_000, layer=3)
LOWER = Label(4, "lower", (50, 180, 50), (255, 0, 0), 20_000, layer=2)
OUTER = Label(5, "outer", (0, 128, 255), (255, 0, 0), 20_000, layer=4)
OBJECT = Label(6, "object", (240, 200, 0), (0, 128, 255), 4_000, rule="isolate")
"""A thing that a person holds or carries, such as a bag: rigid, bound to one joint, and no layer of clothes."""

_BUILT_IN = (SKIN, HAIR, SHOE, UPPER, LOWER, OUTER, OBJECT)
BACKGROUND = -1
"""Label id of pixels and faces that show no part of the person."""
CLOTH_LABELS: tuple[Label, ...] = (UPPER, LOWER, OUTER)
LABEL_BY_NAME: dict[str, Label] = {label.name: label for label in _BUILT_IN}
_CLOTH_KINDS = tuple(label.name for label in CLOTH_LABELS)


@dataclass(frozen=True)
class Labels:
    """The semantic classes of one person: the built-in ones, changed or not, and after them a user's own.

    It is a sequence of `Label` by id.

    Attributes:
        items: the labels; each stands at the place of its id, the seven built-in ones first.

    Raises:
        InputError: names that occur twice, kinds that are no built-in class, or a layer where there can be none.

    Example:
        >>> from smplxpp.core import LABELS
        >>> [label.name for label in LABELS.cloth]
        ['upper', 'lower', 'outer']
    """

    items: tuple[Label, ...] = field(default=_BUILT_IN)

    def __post_init__(self) -> None:
        built_in = tuple(label.name for label in _BUILT_IN)
        if self.names[: len(built_in)] != built_in or [label.id for label in self.items] != list(range(len(self))):
            raise InputError("labels", expected=f"{', '.join(built_in)} first, ids in order", received=str(self.names))
        for label in self.items:
            subject = f"label {label.name!r}"
            if self.names.count(label.name) > 1:
                raise InputError(subject, expected="one class of this name", received="several")
            if label.name in ("body", "background") or _NAME.fullmatch(label.name) is None:
                raise InputError(
                    subject,
                    expected="letters, digits, spaces, - and _, neither body nor background",
                    received=repr(label.name),
                )
            require_choice(f"{subject}: kind", label.kind, built_in)
            if label.id < len(built_in) and label.kind != label.name:
                raise InputError(f"{subject}: kind", expected=f"{label.name}, as it is built in", received=label.kind)
            PartRule.parse(label.rule, subject=f"{subject}: rule")
            if (label.layer is None) != (label.kind in (SKIN.name, OBJECT.name)):
                raise InputError(
                    f"{subject}: layer",
                    expected="a number, and none for skin and things (kinds skin and object)",
                    received=str(label.layer),
                )

    __repr__ = one_line

    def __len__(self) -> int:
        return len(self.items)

    def __iter__(self) -> Iterator[Label]:
        return iter(self.items)

    def __getitem__(self, number: int) -> Label:
        return self.items[number]

    @property
    def names(self) -> tuple[str, ...]:
        """The names in the order of the ids."""
        return tuple(label.name for label in self.items)

    @property
    def own(self) -> tuple[Label, ...]:
        """The user's own labels."""
        return self.items[len(_BUILT_IN) :]

    def named(self, name: str, *, subject: str = "label") -> Label:
        """Return the label of a name.

        Raises:
            InputError: no such label.
        """
        require_choice(subject, name, self.names)
        return self.items[self.names.index(name)]

    @cached_property
    def kinds(self) -> Int64[np.ndarray, " L"]:
        """The id of the built-in class that each label behaves like."""
        return np.array([LABEL_BY_NAME[label.kind].id for label in self.items])

    @cached_property
    def small(self) -> Bool[np.ndarray, " L"]:
        """Which of the user's own labels may be as small as glasses: things, and what is rigid or lies on the skin."""
        out = np.zeros(len(self), dtype=bool)
        for label in self.own:
            out[label.id] = label.kind == OBJECT.name or label.stiff or label.tight
        return out

    def kind_ids(self, label_ids: Integer[np.ndarray, "*N"]) -> Int64[np.ndarray, "*N"]:
        """Replace labels by the built-in classes that they behave like; the background stays."""
        return np.append(self.kinds, BACKGROUND)[np.asarray(label_ids)]

    @property
    def cloth(self) -> tuple[Label, ...]:
        """The labels of clothes: upper, lower, outer, and what behaves like them."""
        return tuple(label for label in self.items if label.kind in _CLOTH_KINDS)

    @property
    def layer_order(self) -> tuple[int, ...]:
        """Label ids from the innermost to the outermost layer."""
        return tuple(label.id for label in sorted(self._layers, key=lambda label: (label.layer, label.id)))

    @property
    def _layers(self) -> tuple[Label, ...]:
        return tuple(label for label in self.items if label.layer is not None)

    def display_colors(
        self, label_ids: Integer[np.ndarray, "*N"], certain: Bool[np.ndarray, "*N"] | None = None
    ) -> UInt8[np.ndarray, "*N 3"]:
        """Return the display colours of label ids, pale where a label is uncertain; the background is black."""
        table = np.array([label.display_rgb for label in self.items] + [(0, 0, 0)], dtype=np.uint8)
        colors = table[np.asarray(label_ids)]
        if certain is None:
            return colors
        # A third of the colour and two of white: still to be told apart.
        return np.where(np.asarray(certain)[..., None], colors, 170 + colors // 3).astype(np.uint8)

    def semantic_colors(self, label_ids: Integer[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N 3"]:
        """Return the semantic colours of label ids; the background is black."""
        table = np.array([label.semantic_rgb for label in self.items] + [(0, 0, 0)], dtype=np.uint8)
        return table[np.asarray(label_ids)]

    def as_list(self) -> list[dict[str, Any]]:
        """Return the labels as plain values, for JSON."""
        return [asdict(label) for label in self.items]

    @staticmethod
    def from_list(value: Any, *, subject: str = "labels") -> Labels:
        """Read what `as_list` wrote.

        Raises:
            InputError: other values.
        """
        rows = as_list(value, subject=subject)
        most = 250  # ids are kept in bytes, of which 255 is the background
        if not len(_BUILT_IN) <= len(rows) <= most:
            raise InputError(subject, expected=f"{len(_BUILT_IN)} to {most} labels", received=str(len(rows)))
        return Labels(tuple(_label(row, k, f"{subject}: label {k}") for k, row in enumerate(rows)))


def _label(row: Any, number: int, subject: str) -> Label:
    values = as_object(row, subject=subject)
    texts = {name: as_text(values.get(name), subject=f"{subject}: {name}") for name in ("name", "kind", "rule")}
    layer = values.get("layer")
    return Label(
        number,
        display_rgb=color(values.get("display_rgb"), subject=f"{subject}: display_rgb"),
        semantic_rgb=color(values.get("semantic_rgb"), subject=f"{subject}: semantic_rgb"),
        face_budget=as_integer(values.get("face_budget"), subject=f"{subject}: face_budget", least=0),
        layer=None if layer is None else as_number(layer, subject=f"{subject}: layer"),
        tight=bool(values.get("tight")),
        **texts,
    )


def color(value: Any, *, subject: str) -> tuple[int, int, int]:
    """Read a colour: three bytes of sRGB, or a text such as "#ff8000".

    Raises:
        InputError: anything else.
    """
    if isinstance(value, str) and len(value) == 7 and value[0] == "#":
        try:
            value = list(bytes.fromhex(value[1:]))
        except ValueError:
            pass
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise InputError(subject, expected='three bytes [255, 128, 0] or "#ff8000"', received=repr(value))
    red, green, blue = (as_integer(one, subject=subject, least=0, most=255) for one in value)
    return red, green, blue


LABELS = Labels()
"""The built-in labels."""
LAYER_ORDER: tuple[int, ...] = LABELS.layer_order
"""Label ids from the innermost to the outermost layer: shoes, trousers, shirt, coat, hair."""


def display_colors(
    label_ids: Integer[np.ndarray, "*N"], certain: Bool[np.ndarray, "*N"] | None = None
) -> UInt8[np.ndarray, "*N 3"]:
    """Return the display colours of built-in label ids, see `Labels.display_colors`."""
    return LABELS.display_colors(label_ids, certain)


def semantic_colors(label_ids: Integer[np.ndarray, "*N"]) -> UInt8[np.ndarray, "*N 3"]:
    """Return the semantic colours of built-in label ids; the background is black."""
    return LABELS.semantic_colors(label_ids)
