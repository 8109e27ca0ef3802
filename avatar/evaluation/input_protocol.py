"""What an evaluation's figures rest on: exact or tracked inputs, by one name and each for itself."""

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
    """The inputs of a run as far as somebody says what they are; nothing in it is guessed.

    Attributes:
        parameters: of the body, among `PARAMETERS`: "tracked" are fitted to images, or exact ones with such errors;
            "mixed": the template's and the frames' are not of one kind.
        labels: of the scan that the template is made of, among `LABELS`.
        normals: maps of the training views, among `NORMALS`; "none": there are no such maps.
        stage: what the run made the parameters by, among `STAGES`; "": they are the capture's.
        views_with_normals, training_views: numbers of the training views that have a map, and of all; None where it is
            not known.
        training_frames, training_cameras: numbers that the models were trained on; None where it is not known.

    Raises:
        InputError: another word.
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
        """Make it of its fields by name, as JSON holds them.

        Raises:
            InputError: another word than those known.
        """
        # The name follows from the fields.
        known = {f.name for f in fields(InputProtocol)} | {"name"}
        require_known("inputs of an evaluation", values, known)
        for field in fields(InputProtocol):
            value = values.get(field.name, field.default)
            if value is not None and not isinstance(value, int if str(field.type).startswith("int") else str):
                raise InputError(
                    f"inputs of an evaluation: {field.name}", expected=str(field.type), received=shown(value)
                )
        return InputProtocol(**{key: value for key, value in values.items() if key != "name"})

    @property
    def name(self) -> str:
        """One word for all inputs, the first of every caption.

        "exact": all that there are are the truth; "tracked": parameters tracked, labels estimated, normals estimated or
        none; "not known": one of them is not; else "mixed".
        """
        if NOT_KNOWN in (self.parameters, self.labels, self.normals):
            return NOT_KNOWN
        if (self.parameters, self.labels) == (EXACT, "true") and self.normals in ("true", "none"):
            return EXACT
        if (self.parameters, self.labels) == (TRACKED, "estimated") and self.normals in ("estimated", "none"):
            return TRACKED
        return MIXED

    def sentence(self) -> str:
        """Everything in one line for a table's caption."""
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
