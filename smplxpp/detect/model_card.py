"""Describe the input and output of a keypoint model in ONNX, by a JSON file beside the model or by default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from smplxpp.body.layout import BODY_25B, BY_COUNT, COCO_17, VOCABULARY, Order
from smplxpp.core import InputError, require_between, require_choice
from smplxpp.core.files.json_file import as_list, as_number, as_numbers, as_object, as_text, read_json

LAYOUTS: dict[str, Order] = {
    "coco-17": COCO_17,
    "body-25": BY_COUNT[25],
    "body-25b": BODY_25B,
    "halpe-26": BY_COUNT[26],
    "coco-wholebody-133": BY_COUNT[133],
    "body-135": BY_COUNT[135],
    "halpe-136": BY_COUNT[136],
}
"""Orders of keypoints that a model card may name."""
LARGEST_SIDE = 8192
"""Largest side of a model's input, pixels."""


@dataclass(frozen=True)
class ModelCard:
    """Input and output conventions of a keypoint model. The defaults are those of mmpose (RTMPose, ViTPose, HRNet),
    which Sapiens shares.

    Attributes:
        names: of its points in the vocabulary of `smplxpp.core.keypoints`, None for a point that has no name there;
            None instead of a list to choose the names by the number of points.
        size: width and height of the input, for models that leave it free.
        mean: of the normalisation, on the scale 0 to 255, in the order of `channels`.
        std: of the normalisation, likewise.
        channels: "rgb" or "bgr".
        padding: factor that enlarges the person's box.
        simcc_split: bins of a simcc output a pixel of the input; None to derive it from the shapes.
        alignment: "corners" for heatmaps whose outermost cells lie on the outermost pixels (UDP: ViTPose, Sapiens,
            RTMO), "stride" for those whose cell k lies on pixel k times the stride.
        least_confidence: confidence from which a point is evidence of a person.
    """

    names: Order | None = None
    size: tuple[int, int] = (192, 256)
    mean: tuple[float, float, float] = (123.675, 116.28, 103.53)
    std: tuple[float, float, float] = (58.395, 57.12, 57.375)
    channels: str = "rgb"
    padding: float = 1.25
    simcc_split: float | None = None
    alignment: str = "stride"
    least_confidence: float = 0.3

    def __post_init__(self) -> None:
        require_choice("channels", self.channels, ("rgb", "bgr"))
        require_choice("alignment", self.alignment, ("stride", "corners"))
        require_between("padding", self.padding, 1.0, 4.0)
        require_between("least_confidence", self.least_confidence, 0.0, 1.0)
        for side in self.size:
            require_between("size", side, 8, LARGEST_SIDE)
        for value in self.std:
            require_between("std", value, 1e-6, 1e6)
        if self.simcc_split is not None:
            require_between("simcc_split", self.simcc_split, 0.1, 64.0)
        if self.names is not None:
            _check_names(self.names)


def card_path(model: Path) -> Path:
    """Return the path of a model's card, beside the model."""
    return model.with_suffix(".json")


def load_card(model: Path) -> ModelCard:
    """Read the card beside a model; the defaults if there is none.

    `{"layout": "coco-17"}` or `{"names": ["nose", null, ...]}` names the points; `size`, `mean`, `std`, `channels`,
    `padding`, `simcc_split`, `alignment` and `least_confidence` are those of `ModelCard`.

    Raises:
        InputError: a damaged file, unknown keys, layouts or names, values out of range.
    """
    path = card_path(model)
    if not path.is_file():
        return ModelCard()
    subject = f"model card {path}"
    content = as_object(read_json(path, subject="model card"), subject=subject)
    known = {*ModelCard.__dataclass_fields__, "layout"}
    if content.keys() - known:
        raise InputError(
            subject,
            expected=f"keys among {', '.join(sorted(known))}",
            received=", ".join(sorted(map(str, content.keys() - known))[:6]),
        )
    return ModelCard(**_values(content, subject))


def card_identity(card: ModelCard) -> str:
    """Return a card as text that is the same for the same settings."""
    return repr(sorted(asdict(card).items()))


def _values(content: Mapping[str, Any], subject: str) -> dict[str, Any]:
    """Convert the values of a card's file, with errors that name the key."""
    out: dict[str, Any] = {}
    # Names come from a known layout or one by one; a list of names overrides the layout.
    if "layout" in content:
        name = as_text(content["layout"], subject=f"{subject}: layout")
        require_choice(f"{subject}: layout", name, tuple(LAYOUTS))
        out["names"] = LAYOUTS[name]
    if content.get("names") is not None:
        named = as_list(content["names"], subject=f"{subject}: names")
        out["names"] = tuple(None if one is None else as_text(one, subject=f"{subject}: names") for one in named)
    for key, count in (("mean", 3), ("std", 3), ("size", 2)):
        if key in content:
            values = as_numbers(content[key], (count,), subject=f"{subject}: {key}")
            out[key] = tuple(int(v) if key == "size" else float(v) for v in values)
    for key in ("padding", "simcc_split", "least_confidence"):
        if content.get(key) is not None:
            out[key] = as_number(content[key], subject=f"{subject}: {key}")
    for key in ("channels", "alignment"):
        if key in content:
            out[key] = as_text(content[key], subject=f"{subject}: {key}")
    return out


def _check_names(names: Order) -> None:
    """Refuse unknown and repeated names, and more points than any model has."""
    most_points = 4096
    named = [name for name in names if name is not None]
    unknown = [name for name in named if name not in VOCABULARY]
    if unknown or len(set(named)) < len(named) or not named or len(names) > most_points:
        raise InputError(
            "names of keypoints",
            expected="names of docs/captures.md, each once, null for a point that has none there",
            received=", ".join(unknown[:6]) or ("some twice" if named else "none"),
        )
