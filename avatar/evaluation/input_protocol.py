"""What an evaluation's figures rest on: exact or tracked parameters, true or estimated labels and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from smplxpp.core.validation import require_choice

NOT_KNOWN = "not known"
PARAMETERS = ("exact", "tracked", NOT_KNOWN)
LABELS = ("true", "estimated", NOT_KNOWN)
NORMALS = ("true", "estimated", "none", NOT_KNOWN)


@dataclass(frozen=True)
class InputProtocol:
    """The inputs of a run as far as somebody says what they are; nothing in it is guessed.

    Attributes:
        parameters: of the body, among `PARAMETERS`: "tracked" are fitted to images, or exact ones with such errors.
        labels: of the scan that the template is made of, among `LABELS`.
        normals: maps of the training views, among `NORMALS`; "none": there are no such maps.
        training_frames, training_cameras: numbers that the models were trained on; None where it is not known.

    Raises:
        InputError: another word.
    """

    parameters: str = NOT_KNOWN
    labels: str = NOT_KNOWN
    normals: str = NOT_KNOWN
    training_frames: int | None = None
    training_cameras: int | None = None

    def __post_init__(self) -> None:
        for name, choices in (("parameters", PARAMETERS), ("labels", LABELS), ("normals", NORMALS)):
            require_choice(f"inputs of an evaluation: {name}", getattr(self, name), choices)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> InputProtocol:
        """Make it of its fields by name, as JSON holds them.

        Raises:
            InputError: another word than those known.
        """
        return InputProtocol(**values)

    def sentence(self) -> str:
        """Everything in one line for a table's caption."""
        trained = "trained on a number of frames that is not known"
        if self.training_frames is not None and self.training_cameras is not None:
            trained = (
                f"trained on {counted(self.training_frames, 'frame')} of {counted(self.training_cameras, 'camera')}"
            )
        return f"parameters {self.parameters}, labels {self.labels}, normals {self.normals}, {trained}"


def counted(number: int, thing: str) -> str:
    """Return a number of things in words."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"
