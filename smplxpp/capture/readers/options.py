"""What `open_capture` passes on to every reader."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from smplxpp.body import BodyModel


@dataclass(frozen=True, eq=False)
class ReaderOptions:
    """Choices of the user.

    Attributes:
        params: a parameter file or folder instead of the set's own.
        protocol: name of the protocol whose files are read; None: without one.
        body: the body model that the parameters are for; None: the open body.
        person: whose keypoints are taken, where there are several people; None: the surest.
    """

    params: Path | None = None
    protocol: str | None = None
    body: BodyModel | None = None
    person: int | None = None
