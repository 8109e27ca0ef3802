"""Describe the inputs behind an evaluation's figures: exact, tracked or mixed, one by one and in one word."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from smplxpp.core import InputError, require_choice, require_known
from smplxpp.core.files.json_file import shown

NOT_KNOWN, EXACT, TRACKED, MIXED = "not known", "exact", "tracked", "mixed"
PARAMETERS = (EXACT, TRACKED, MIXED, NOT_KNOWN)
STAGES = ("", "registered", "refined")
LABELS = ("true", "estimated", NOT_KNOWN)
NORMALS = ("true", "estimated", "none", NOT_KNOWN)


@dataclass(frozen=True)
class InputProtocol:
    """The origin of the inputs of a run, as far as it is recorded; nothing is guessed.

    Attributes:
        parameters: of the body, among `PARAMETERS`. "tracked": fitted to images, or exact ones with such errors added;
            "mixed": of different kinds for template and frames.
        labels: of the template's scan, among `LABELS`.
        normals: maps of the training views, among `NORMALS`; "none": there are no maps.
        training_frames: number of frames that the models were trained on; None: not known.
        training_cameras: number of cameras that the models were trained on; None: not known.
        stage: stage of the run that estimated the parameters, among `STAGES`; "": they are the capture's.
        views_with_normals: number of training views with a normal map; None: not known.
        training_views: number of all training views; None: not known.

    Raises:
        InputError: a value that is not among the choices.
    """

    parameters: str = NOT_KNOWN
    labels: str = NOT_KNOWN
    normals: str = NOT_KNOWN
    training_frames: int | None = None
    training_cameras: int | None = None
    stage: str = ""
    views_with_normals: int | None = None
    training_views: int | None = None

    def __post_init__(self) -> None:
        for name, choices in (
            ("parameters", PARAMETERS),
            ("labels", LABELS),
            ("normals", NORMALS),
            ("stage", STAGES),
        ):
            require_choice(f"inputs of an evaluation: {name}", getattr(self, name), choices)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> InputProtocol:
        """Return the protocol whose fields JSON holds by name.

        Raises:
            InputError: an unknown field or value.
        """
        # The name follows from the fields.
        known = {f.name for f in fields(InputProtocol)} | {"name"}
        require_known("inputs of an evaluation", values, known)
        # JSON has no classes: check each value against the type of its field, integers or texts.
        for field in fields(InputProtocol):
            value = values.get(field.name, field.default)
            if value is not None and not isinstance(value, int if str(field.type).startswith("int") else str):
                raise InputError(
                    f"inputs of an evaluation: {field.name}", expected=str(field.type), received=shown(value)
                )
        return InputProtocol(**{key: value for key, value in values.items() if key != "name"})

    @property
    def name(self) -> str:
        """One word for all inputs, with which every caption begins.

        "exact": all given inputs are the truth; "tracked": parameters are tracked, labels estimated, and normals
        estimated or none; "not known": one of them is not known; else "mixed".
        """
        # One unknown input makes the whole unknown; "exact" and "tracked" need all inputs to agree.
        if NOT_KNOWN in (self.parameters, self.labels, self.normals):
            return NOT_KNOWN
        if (self.parameters, self.labels) == (EXACT, "true") and self.normals in ("true", "none"):
            return EXACT
        if (self.parameters, self.labels) == (TRACKED, "estimated") and self.normals in ("estimated", "none"):
            return TRACKED
        return MIXED

    def sentence(self) -> str:
        """Return all inputs in one line for a table's caption."""
        # Each part is named only as far as it is known, so that a caption never states a guess.
        trained = "trained on a number of frames that is not known"
        if self.training_frames is not None and self.training_cameras is not None:
            trained = (
                f"trained on {counted(self.training_frames, 'frame')} of {counted(self.training_cameras, 'camera')}"
            )
        made = f" ({self.stage})" if self.stage else ""
        there, all_views = self.views_with_normals, self.training_views
        some = there is not None and all_views is not None and 0 < there < all_views and self.normals != "none"
        views = f" ({there:,} of {counted(all_views or 0, 'view')})" if some else ""
        return f"parameters {self.parameters}{made}, labels {self.labels}, normals {self.normals}{views}, {trained}"

    def caption(self, text: str) -> str:
        """Return a caption that begins with the name."""
        return f"{self.name}: {text}"


def counted(number: int, thing: str) -> str:
    """Return a number of things in words."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"
